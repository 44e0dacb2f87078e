"""Which clusters and charge functions a scene needs."""
