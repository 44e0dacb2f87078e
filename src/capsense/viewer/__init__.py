"""A live view of a sensor in a web browser.

A :class:`~capsense.viewer.source.Source` gives readings, a
:class:`~capsense.viewer.player.Player` asks it for them in a thread of its own, and a
:class:`~capsense.viewer.view.LiveView` draws the newest. :func:`show` shows a sensor on a robot.
"""

from capsense.viewer.attached import SensorStream, Show, show

__all__ = ["SensorStream", "Show", "show"]
