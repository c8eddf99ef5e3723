"""netdesign: photogrammetric camera networks, designed and proved."""

__version__ = "0.1.0"
