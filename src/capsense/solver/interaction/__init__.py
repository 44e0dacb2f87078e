"""What active clusters of bodies meet of each other."""
