"""A headless Chromium, driven by its DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import count
from pathlib import Path
from typing import Any

from tornado.websocket import WebSocketClientConnection, websocket_connect

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Tab:
    """A tab.

    Attributes:
        faults: errors on its console.
    """

    def __init__(self, connection: WebSocketClientConnection) -> None:
        self._connection, self._numbers = connection, count(1)
        self._session: dict[str, str] = {}
        self.faults: list[Any] = []

    async def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the protocol; return its result."""
        number = next(self._numbers)
        await self._connection.write_message(
            json.dumps({"id": number, "method": method, "params": parameters, **self._session})
        )
        while True:
            message = await self._connection.read_message()
            assert message is not None, "Chromium has ended"
            answer = json.loads(message)
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded") or (
                answer.get("method") == "Runtime.consoleAPICalled" and answer["params"]["type"] == "error"
            ):
                self.faults.append(answer["params"])
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    async def open(self, url: str, width: int, height: int, touch: bool = False) -> None:
        """Open a page in a window of a size [px]."""
        target = await self.call("Target.createTarget", url="about:blank")
        attached = await self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        await self.resize(width, height, touch)
        for domain in ("Page", "Runtime", "Log"):
            await self.call(f"{domain}.enable")
        await self.call("Page.navigate", url=url)
        await self.until(f"location.href === {json.dumps(url)} && document.readyState === 'complete'")

    async def resize(self, width: int, height: int, touch: bool = False) -> None:
        """Set the size of the window [px]."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": touch}
        await self.call("Emulation.setDeviceMetricsOverride", **size)
        await self.call("Emulation.setTouchEmulationEnabled", enabled=touch)

    async def value(self, expression: str) -> Any:
        """Evaluate JavaScript."""
        answer = await self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    async def until(self, condition: str, seconds: float = 60.0) -> None:
        """Wait until JavaScript is true."""
        for _ in range(int(seconds / 0.1)):
            if await self.value(condition):
                return
            await asyncio.sleep(0.1)
        raise AssertionError(f"never true: {condition}; {self.faults}")

    async def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Dispatch a mouse event at a position [px]."""
        await self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, **more)

    async def key(self, text: str) -> None:
        """Press a letter."""
        await self.call("Input.dispatchKeyEvent", type="keyDown", text=text, key=text)
        await self.call("Input.dispatchKeyEvent", type="keyUp", key=text)

    async def screenshot(self, path: Path) -> None:
        """Save what a person would see."""
        shot = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(shot["data"]))


@asynccontextmanager
async def chromium(folder: Path) -> AsyncIterator[Tab]:
    """Start Chromium, with its profile in a folder."""
    assert PROGRAM is not None
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--remote-debugging-port=0"]
    process = await asyncio.create_subprocess_exec(
        *(PROGRAM, *options, f"--user-data-dir={folder}", "about:blank"), stderr=asyncio.subprocess.PIPE
    )
    try:
        assert process.stderr is not None
        while not (address := re.search(r"ws://\S+", (await process.stderr.readline()).decode())):
            pass
        connection = await websocket_connect(address[0], max_message_size=1 << 26)
        yield Tab(connection)
        connection.close()
        while await connection.read_message() is not None:
            pass
    finally:
        process.terminate()
        await process.wait()
