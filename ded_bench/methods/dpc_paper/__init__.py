"""The policy of the paper: its network, features, loss and training."""
