# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Interactive figures in a page: compressed together with their library; the page's script draws those in view."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping
from functools import cache

from bokeh.core.json_encoder import serialize_json
from bokeh.document import Document
from bokeh.models import ColumnDataSource, UIElement
from bokeh.resources import Resources
from markupsafe import Markup


def pack(models: Mapping[str, UIElement]) -> tuple[dict[str, Markup], Markup]:
    """The place of each figure, and what follows once in a page, before its scripts."""
    document = Document()
    shelf = ColumnDataSource(name="figures", tags=list(models.values()))  # no figure is a root: none is drawn at once
    with document.models.freeze():
        document.add_root(shelf)
    places = {
        name: Markup('<div class="figure" data-figure="{}" style="height: {}px"></div>').format(model.id, model.height)
        for name, model in models.items()
    }
    blocks = {"library": _library(), "figures": _packed(serialize_json(document.to_json(deferred=False)).encode())}
    block = Markup('<script type="text/plain" id="{}">{}</script>\n')
    return places, Markup().join(block.format(name, text) for name, text in blocks.items())


@cache
def _library() -> str:
    return _packed(Resources(mode="inline", components=["bokeh"]).js_raw[0].encode())


def _packed(content: bytes) -> str:
    """As gzip in base64; the same bytes give the same text."""
    return base64.b64encode(gzip.compress(content, mtime=0)).decode()
