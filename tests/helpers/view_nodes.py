"""What a page shows."""

from __future__ import annotations

from typing import Any


def nodes_of(server: Any) -> dict[str, Any]:
    """The nodes of a viser server's scene by name; viser has no public way to ask for them."""
    return dict(server.scene._handle_from_node_name)
