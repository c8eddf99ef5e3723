"""Synthetic images and the measurement of tags in them."""
