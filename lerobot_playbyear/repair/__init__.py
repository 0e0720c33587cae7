"""Repairing datasets: those that a killed recording left half-written, and those that were damaged later."""
