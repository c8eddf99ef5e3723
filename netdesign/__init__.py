"""netdesign: photogrammetric camera networks, designed and proved."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("netdesign")
except PackageNotFoundError:  # run from a source tree that was never installed
    __version__ = "0.0.0"
