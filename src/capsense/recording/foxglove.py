"""A layout for Foxglove: sensor and bodies in 3-D, charts of the strongest channels."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._style import COLOURS
from capsense.scenario.model import Channel

MAX_LINES = 8
"""So many channels are drawn in a chart, the strongest."""
_VIEW, _FOV = 0.5, 45.0


def layout(name: str, channels: Sequence[Channel], peaks: NDArray[np.float64]) -> str:
    """The layout of a recording, as JSON that Foxglove imports.

    Args:
        name: Of the sensor.
        channels: Those in its ``signals``.
        peaks: Their largest changes [F], shape (K,).
    """
    panels: dict[str, Any] = {"3D!sensor": _scene(name)}
    for key, title, own in (("own", "electrodes", True), ("pairs", "pairs", False)):
        found = [k for k, c in enumerate(channels) if (c.row == c.column) == own]
        strongest = sorted(sorted(found, key=lambda k: -peaks[k])[:MAX_LINES])
        if strongest:
            drawn = [channels[k] for k in strongest]
            panels[f"Plot!{key}"] = _chart(name, f"{title}, change [fF]", drawn)
    return json.dumps(
        {
            "configById": panels,
            "globalVariables": {},
            "userNodes": {},
            "playbackConfig": {"speed": 1},
            "layout": _beside([key for key in panels if key.startswith("Plot")]),
        },
        indent=1,
    )


def _beside(charts: Sequence[str]) -> Any:
    """The scene on the left, charts below each other on the right."""
    right: Any = charts[0]
    if len(charts) > 1:
        right = {"direction": "column", "first": charts[0], "second": charts[1]}
    return {"direction": "row", "first": "3D!sensor", "second": right, "splitPercentage": 55}


def _scene(name: str) -> dict[str, Any]:
    return {
        "cameraState": {
            "perspective": True, "distance": _VIEW, "phi": 60.0, "thetaOffset": 30.0,
            "target": [0.0, 0.0, 0.0], "targetOffset": [0.0, 0.0, 0.1 * _VIEW],
            "targetOrientation": [0.0, 0.0, 0.0, 1.0], "fovy": _FOV, "near": 1e-3, "far": 100.0,
        },
        "followMode": "follow-none", "followTf": name, "scene": {}, "transforms": {},
        "topics": {f"/{name}/{topic}": {"visible": True} for topic in ("electrodes", "markers")},
        "layers": {
            "grid": {
                "layerId": "foxglove.Grid", "instanceId": "grid", "label": "10 mm",
                "visible": True, "frameLocked": True, "frameId": name, "size": 0.4,
                "divisions": 40, "lineWidth": 1, "color": "#8a8f9440",
                "position": [0.0, 0.0, 0.0], "rotation": [0.0, 0.0, 0.0],
            }
        },
    }  # fmt: skip


def _chart(name: str, title: str, channels: Sequence[Channel]) -> dict[str, Any]:
    paths = [
        {
            "value": f'/{name}/signals.channels[:]{{name=="{channel.column_name}"}}.change',
            "label": channel.label,
            "color": COLOURS[k % len(COLOURS)],
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for k, channel in enumerate(channels)
    ]
    return {
        "foxglovePanelTitle": title, "paths": paths, "xAxisVal": "timestamp", "isSynced": True,
        "showLegend": True, "legendDisplay": "top", "showPlotValuesInLegend": True,
        "showXAxisLabels": True, "showYAxisLabels": True, "sidebarDimension": 240,
    }  # fmt: skip
