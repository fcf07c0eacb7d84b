"""Learned dispatch policies: the paper's recipe (policy, features, loss, train) and ours (ded_dpc)."""
