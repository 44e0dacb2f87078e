"""Pictures and videos of what the page shows, for the one who watches."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from capsense.viewer.player import Playback

if TYPE_CHECKING:
    from viser import GuiApi

SIZE = (720, 1280)
"""Rows and columns of pictures and videos."""
MOST = 200
"""Frames of a video; of longer recordings every so many samples are taken."""
PATIENCE = 5.0
"""Longest wait for a sample [s]."""
SETTLE = 0.12
"""Time for a sample to reach the page [s]."""


class ExportControls:
    """Buttons that hand the picture, or a video from the first sample to the last, to a browser."""

    def __init__(self, gui: GuiApi, player: Playback) -> None:
        with gui.add_folder("export", expand_by_default=False):
            picture = gui.add_button("Picture (.png)")
            picture.on_click(lambda event: send_picture(event.client))
            if not player.live:
                video = gui.add_button("Video (.webp)")
                video.on_click(lambda event: send_video(event.client, player))


def send_picture(client: Any) -> None:
    """Render what a client sees, and hand it over."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(_seen(client)).save(file, "png")
    client.send_file_download("capsense.png", file.getvalue(), save_immediately=True)


def send_video(client: Any, player: Playback, wait: Callable[[float], None] = time.sleep) -> None:
    """Render the samples one after the other as a client sees them, and hand them over."""
    from PIL import Image

    first, last = player.span
    frames = []
    for index in np.unique(np.linspace(first, last, min(MOST, last - first + 1)).astype(int)):
        player.go(int(index))
        for _ in range(round(PATIENCE / 0.01)):
            if player.newest is not None and player.newest.index == index:
                break
            wait(0.01)
        wait(SETTLE)
        try:
            frames.append(Image.fromarray(_seen(client)))
        except RuntimeError:  # the client has left
            return
    times, _ = player.history(last)
    long = float(times[-1] - times[0]) / max(len(frames) - 1, 1)
    file = io.BytesIO()
    frames[0].save(
        file, "webp", save_all=True, append_images=frames[1:], quality=80, loop=0,
        duration=max(20, round(1e3 * long)),
    )  # fmt: skip
    client.send_file_download("capsense.webp", file.getvalue(), save_immediately=True)


def _seen(client: Any) -> Any:
    return client.get_render(*SIZE, transport_format="png")[..., :3]
