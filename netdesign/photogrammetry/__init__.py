"""Kernels of photogrammetry: arrays in, arrays out."""
