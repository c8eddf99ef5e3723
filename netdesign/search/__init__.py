"""Many-objective search on plain arrays; knows no camera."""
