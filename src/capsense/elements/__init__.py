"""What the surface core needs of a body by itself: panels, charge functions, energies, matter."""
