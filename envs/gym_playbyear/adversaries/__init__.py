"""Adversaries: whoever tries to solve the tasks without hearing. A task is worth hearing for as far as they fail."""
