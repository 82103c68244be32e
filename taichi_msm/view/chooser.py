"""List of scenes on a page, from which a session begins."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

from tornado.template import Template

from taichi_msm.errors import Pause
from taichi_msm.view.web import Address, Guarded, PageFile, page_file, serving

# Interval at which an interruption is noticed [s].
PAUSE_INTERVAL_S = 0.1


async def choose(
    address: Address, scenes: Mapping[str, str], pause: Pause, warn: Callable[[str], None], fault: str = ""
) -> str:
    """Serve a list of scenes, from name to summary, until a page chooses one; return its name.

    `fault` is the error of the last choice. `pause` is called several times a second. The page then waits for the
    session, which the next server at the address serves.
    """
    chosen: list[str] = []
    handlers = [
        (r"/[^/]+/", _List, {"address": address, "scenes": scenes, "fault": fault, "choose": chosen.append}),
        (r".*", PageFile, {"address": address}),
    ]
    async with serving(address, handlers, warn, lambda: None):
        while not chosen:
            pause()
            await asyncio.sleep(PAUSE_INTERVAL_S)
    return chosen[0]


class _List(Guarded):
    """Handler of the list; a request with the name of a scene chooses it."""

    def initialize(  # type: ignore[override]
        self, address: Address, scenes: Mapping[str, str], fault: str, choose: Callable[[str], None]
    ) -> None:
        super().initialize(address)
        self.scenes, self.fault, self.choose = scenes, fault, choose

    def get(self) -> None:
        name = self.get_query_argument("scene", "")
        chosen = name if name in self.scenes else ""
        template = Template(page_file("scenes.html").decode())
        self.write(template.generate(scenes=self.scenes, fault=self.fault, chosen=chosen))
        if chosen:
            self.choose(chosen)
