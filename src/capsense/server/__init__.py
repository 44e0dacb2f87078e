"""Sensors over a WebSocket: depth images or bodies in, readings out.

- :mod:`~capsense.server.frames`: binary messages
- :mod:`~capsense.server.messages`: control messages, JSON
- :mod:`~capsense.server.sensor`: one sensor of one client
- :mod:`~capsense.server.session`: one client
- :mod:`~capsense.server.server`: all of them
- :mod:`~capsense.server.client`: the other side, in Python

The protocol is described in ``docs/protocol.md``.
"""
