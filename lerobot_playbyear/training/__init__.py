"""Training with the dataset in memory."""
