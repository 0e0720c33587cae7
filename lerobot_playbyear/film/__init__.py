"""Films with sound."""
