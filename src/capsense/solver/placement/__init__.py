"""Where the active clusters are, and what the design does to them."""
