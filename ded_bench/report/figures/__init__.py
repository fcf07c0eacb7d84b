"""Figures, drawn from tables and trajectories."""
