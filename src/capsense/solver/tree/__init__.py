"""Bodies as trees of clusters: charge functions, potential coefficients, materials."""
