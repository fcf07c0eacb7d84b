"""What really happens: the swing equations, their simulation, and the scorer; knows no method."""
