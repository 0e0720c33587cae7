"""The policy `playbyear`: configuration, network, processors, and what its card says."""
