"""Adversaries: scripts and learners that try to solve the tasks without hearing. A task is worth hearing for as far as they fail."""
