"""A browser that a test controls: Chromium over its DevTools protocol."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
from contextlib import contextmanager
from urllib.request import urlopen

import pytest
from patience import PATIENCE, wait_until
from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def find_browser() -> str:
    """Return the browser; skip where there is none, unless it is required."""
    result = next((path for name in NAMES if (path := shutil.which(name))), None)
    if result is None:
        if os.environ.get("NEUROSIM_BROWSER_REQUIRED"):
            pytest.fail("a browser is required here, and there is none")
        pytest.skip("no Chromium on this computer")
    return result


class Tab:
    """One tab, whose console messages are kept."""

    def __init__(self, socket):
        self._socket = socket
        self._last = 0
        self.complaints = []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        self._last += 1
        self._socket.send(json.dumps({"id": self._last, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get("id") == self._last:
                assert "error" not in message, message["error"]
                return message["result"]
            self._hear(message)

    def _hear(self, message):
        if message.get("method") == "Runtime.exceptionThrown":
            self.complaints.append(message["params"]["exceptionDetails"]["text"])
        elif message.get("method") == "Log.entryAdded":
            entry = message["params"]["entry"]
            if entry["level"] in ("error", "warning"):
                self.complaints.append(f"{entry['text']} {entry.get('url', '')}")

    def open(self, url):
        """Leave the open page, forget its console messages, and open another page."""
        self._go("about:blank")
        self.complaints.clear()  # a page whose server has ended reports it until it is left
        self._go(url)

    def _go(self, url):
        self.call("Page.navigate", url=url)
        self.until("document.readyState === 'complete'")

    def run(self, script):
        """Return the value of an expression, awaited if it is a promise."""
        answer = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, condition):
        """Wait until an expression is true, and return its value."""
        return wait_until(lambda: self.run(condition), condition)

    def click(self, x, y):
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def click_on(self, selector):
        """Click on an element, again where the page has moved it away before the click came."""
        element = f"document.querySelector({json.dumps(selector)})"
        self.run(
            "(() => { window.hit = false;"
            f"{element}.addEventListener('click', () => {{ window.hit = true; }},"
            "{capture: true, once: true}); })()"
        )

        def hit():
            self.click(*self.run(
                f"(() => {{ const e = {element};"
                "e.scrollIntoView({block: 'nearest'}); const b = e.getBoundingClientRect();"
                "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
            ))  # fmt: skip
            return self.run("window.hit !== false")  # another page does not know of it

        wait_until(hit, f"a click on {selector}")

    def press(self, key, text="", modifiers=0):
        for kind in ("Down", "Up"):
            self.key(kind, key, text=text, modifiers=modifiers)

    def key(self, kind, key, **others):
        """Have a key go ``Down`` or ``Up``."""
        self.call("Input.dispatchKeyEvent", type=f"key{kind}", key=key, code=key, **others)

    def type(self, text):
        self.call("Input.insertText", text=text)

    def screenshot(self, path):
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))


@contextmanager
def browser_tab(folder, size=(1280, 900)):
    """Start a browser with its profile in a folder; give its one tab."""
    process = subprocess.Popen(
        [
            find_browser(),
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            f"--window-size={size[0]},{size[1]}",
            "--remote-debugging-port=0",
            f"--user-data-dir={folder / 'profile'}",
            "about:blank",
        ],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        port = None
        for line in process.stderr:
            if match := re.search(r"DevTools listening on ws://[^:]+:(\d+)/", line):
                port = match[1]
                break
        assert port, "the browser did not start"
        with urlopen(f"http://127.0.0.1:{port}/json") as reply:
            pages = [page for page in json.load(reply) if page["type"] == "page"]
        with connect(pages[0]["webSocketDebuggerUrl"], max_size=None) as socket:
            yield Tab(socket)
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE)
