"""Learned ADMM on islands: iterations on the plant's own linearisation, between coarse simulations."""
