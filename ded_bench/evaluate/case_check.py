"""What a grid is like before anything is solved on it: its modes, how much can be served, what static dispatch does."""
