"""What is nearer to the design, or to another body, than clusters resolve."""
