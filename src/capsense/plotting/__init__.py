"""Pictures of designs, runs and chips; :func:`capsense.plot` is the door to them."""
