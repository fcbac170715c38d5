# SPDX-License-Identifier: Apache-2.0
"""Pictures of pages in a browser: ``python docs/viewer_pictures.py WHAT OUTPUT PICTURE.jpg``.

WHAT is ``room``, ``frame``, ``object`` or ``voxel`` of what ``raytran predict`` wrote, as ``raytran view``
shows it, or ``page``, ``phone`` or ``dark`` of an HTML file. It needs Chromium, which is asked through its
DevTools protocol; without a GPU the viewer draws in software, which takes some seconds.
"""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from websockets.sync.client import ClientConnection, connect

from raytran.viewer.app import ViewerApp
from raytran.viewer.server import quiet_server

WINDOW, PHONE = (1280, 800), (390, 844)
PAGE_PART = 1500
"""Rows of a long page that are shown."""

SECONDS = 6
"""Until everything is drawn."""


class Browser:
    """A page of a browser that runs without a screen."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._count = socket, 0

    def ask(self, method: str, **settings: Any) -> dict[str, Any]:
        """Return the answer to one message of the DevTools protocol."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": settings}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == self._count:
                return answer["result"]

    def close_notices(self) -> None:
        """Take away the notice that WebGL is drawn in software."""
        script = "document.querySelectorAll('.mantine-Notifications-root').forEach(e => e.remove())"
        self.ask("Runtime.evaluate", expression=script)

    def picture(self, rows: int) -> Image.Image:
        """Return the upper rows of the page."""
        width = self.ask("Page.getLayoutMetrics")["cssLayoutViewport"]["clientWidth"]
        clip = {"x": 0, "y": 0, "width": width, "height": rows, "scale": 1}
        answer = self.ask("Page.captureScreenshot", format="png", clip=clip, captureBeyondViewport=True)
        return Image.open(io.BytesIO(base64.b64decode(answer["data"]))).convert("RGB")


@contextmanager
def browse(address: str, size: tuple[int, int], *, dark: bool = False) -> Iterator[Browser]:
    """Open a page while a block runs; one as narrow as a phone's is a phone's."""
    program = os.environ.get("CHROMIUM") or shutil.which("chromium") or "google-chrome"
    flags = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        flags += ["--hide-scrollbars", "--remote-debugging-port=0", f"--user-data-dir={profile}"]
        process = subprocess.Popen([program, *flags, "about:blank"], stderr=subprocess.DEVNULL)
        try:
            told = Path(profile) / "DevToolsActivePort"
            while not told.is_file() or not told.read_text():
                time.sleep(0.1)
            port = told.read_text().split()[0]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
                pages = [page for page in json.load(answer) if page["type"] == "page"]
            with connect(pages[0]["webSocketDebuggerUrl"], max_size=None) as socket:
                browser = Browser(socket)
                width, height = size
                is_phone = size == PHONE
                shape = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": is_phone}
                browser.ask("Emulation.setDeviceMetricsOverride", **shape)
                scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
                browser.ask("Emulation.setEmulatedMedia", features=[scheme])
                browser.ask("Page.navigate", url=address)
                time.sleep(SECONDS)
                yield browser
        finally:
            process.terminate()
            process.wait()


def look(app: ViewerApp, what: str) -> None:
    """Have the viewer show something."""
    client = list(app.server.get_clients().values())[-1]
    center = app.scene.objects.center.double().numpy()
    if what == "frame":
        app.select_frame(len(app.scene.images) // 3)
        app._look_from_frame(client)
    elif what == "object":
        app.select_object(app.scene.objects.category.index("chair"))
        middle = center[app.object]
        with client.atomic():
            client.camera.position = middle + np.array([-1.2, -1.6, 1.4])
            client.camera.look_at = middle
    elif what == "voxel":
        app.layers["voxels"].value, app.layers["meshes"].value = True, False
        app.update()
        eye = np.array(client.camera.position)
        app.select_voxel_along(eye, center[0] - eye)


def viewer_picture(folder: Path, what: str) -> Image.Image:
    """Return the viewer as it shows a result."""
    with quiet_server() as server:
        app = ViewerApp(server, {folder.name: folder})
        with browse(f"http://127.0.0.1:{server.get_port()}/", WINDOW) as browser:
            while not server.get_clients():
                time.sleep(0.1)
            time.sleep(SECONDS)
            look(app, what)
            time.sleep(SECONDS)
            browser.close_notices()
            return browser.picture(WINDOW[1])


def page_picture(page: Path, what: str) -> Image.Image:
    """Return the beginning of an HTML file."""
    size = PHONE if what == "phone" else WINDOW
    with browse(page.resolve().as_uri(), size, dark=what == "dark") as browser:
        return browser.picture(PAGE_PART)


if __name__ == "__main__":
    wanted, source, target = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    draw = page_picture if wanted in ("page", "phone", "dark") else viewer_picture
    draw(source, wanted).save(target, quality=82, optimize=True)
