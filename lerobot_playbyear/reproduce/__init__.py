"""The paper's experiments by one command: a plan of cells, each a few ordinary commands, and a report of what came out."""
