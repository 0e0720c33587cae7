"""Recording demonstrations, of a script or of a person."""
