"""A picture in space for a page that stands alone: three.js, the drawing and its data, folded until it is opened."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

from markupsafe import Markup

from casacal.pages.drawing import tag


def static(name: str) -> bytes:
    """A script of this folder as it is shipped."""
    return (resources.files("casacal.pages") / "static" / name).read_bytes()


def space_fold(title: str, words: str, data: Mapping[str, Any]) -> Markup:
    """A fold that shows `casacal.planning.scene` data with a `map` of coloured points; one on a page.

    It needs a browser with WebGL, no network and no other file; the same data give the same bytes.
    """
    three = base64.b64encode(gzip.compress(static("three.module.min.js"), mtime=0)).decode()
    written = json.dumps(data, allow_nan=False).replace("<", "\\u003c")  # a name could end the script
    return tag(
        "details",
        tag("summary", title),
        tag("canvas", at={"id": "space-view", "tabindex": "0", "role": "img", "aria-label": words}),
        tag("p", f"{words} Drag to turn; wheel, two fingers, arrow keys and + and − as well.", at={"class": "note"}),
        tag("script", Markup(three), at={"id": "space-three", "type": "text/plain"}),
        tag("script", Markup(static("space.js").decode()), at={"id": "space-code", "type": "text/plain"}),
        tag("script", Markup(written), at={"id": "space-data", "type": "application/json"}),
        tag("script", Markup(static("fold.js").decode())),
        at={"id": "space-fold"},
    )
