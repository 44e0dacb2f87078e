"""A live view of a sensor in a web browser.

A :class:`~capsense.viewer.source.Source` gives readings, a
:class:`~capsense.viewer.player.Player` asks it for them in a thread of its own, and a
:class:`~capsense.viewer.view.LiveView` draws the newest.
"""
