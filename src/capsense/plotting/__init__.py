"""Pictures of designs, runs and chips; :func:`capsense.plot` draws any of them."""
