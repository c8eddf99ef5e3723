"""Where the search meets photogrammetry."""
