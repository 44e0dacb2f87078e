"""The system of equations of a scene, its solution, and the step as a whole."""
