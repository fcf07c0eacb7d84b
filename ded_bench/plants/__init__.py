"""What is simulated: plants behind one protocol, their simulation, and the scorer; knows no method."""
