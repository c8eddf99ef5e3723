"""``python -m netdesign`` is ``netdesign``."""

from netdesign.cli import main

main()
