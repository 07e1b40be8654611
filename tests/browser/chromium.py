"""A headless Chromium without a network, driven by Playwright."""

from __future__ import annotations

import shutil
from importlib.util import find_spec
from types import TracebackType
from typing import Any, Self

#: The browser, by the names that distributions give it.
PROGRAM = next(
    (
        found
        for name in ("chromium", "chromium-browser", "google-chrome", "chrome")
        if (found := shutil.which(name))
    ),
    None,
)
#: Why there is no browser here; empty where there is one.
MISSING = (
    "needs a Chromium: apt-get install chromium"
    if PROGRAM is None
    else ""
    if find_spec("playwright")
    else "needs Playwright: pip install 'nnode[test]'"
)

_OPTIONS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    # this machine alone: every other name is unknown
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
]


class Browser:
    """One page in a browser of its own; use as a context manager.

    Attributes:
        page: Playwright's.
        complaints: errors and warnings of the console, uncaught exceptions, failed requests.
        requests: addresses that were asked for, those inside the page left out.
    """

    page: Any

    def __init__(self) -> None:
        self.complaints: list[str] = []
        self.requests: list[str] = []

    def __enter__(self) -> Self:
        from playwright.sync_api import sync_playwright

        self._playwright = sync_playwright().start()
        self._chromium = self._playwright.chromium.launch(executable_path=PROGRAM, args=_OPTIONS)
        self._new_page()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._chromium.close()
        self._playwright.stop()

    def _new_page(self, **options: Any) -> None:
        self.page = self._chromium.new_page(**options)
        self.page.on("console", self._hear)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", self._note)

    def open(
        self, address: str, width: int = 1200, height: int = 900, *, motion: bool = True
    ) -> None:
        """Load a page in a new window of a size, px; what was seen before is forgotten.

        Args:
            motion: False: the reader asked for less of it.
        """
        self.page.close()
        self.complaints.clear()
        self.requests.clear()
        self._new_page(
            viewport={"width": width, "height": height},
            is_mobile=width < 600,
            reduced_motion="no-preference" if motion else "reduce",
        )
        self.page.goto(address)

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression; a promise is waited for."""
        return self.page.evaluate(expression)

    def press(self, key: str) -> None:
        """Press and release a key."""
        self.page.keyboard.press(key)

    def _hear(self, message: Any) -> None:
        if message.type in ("error", "warning", "assert"):
            self.complaints.append(message.text)

    def _note(self, request: Any) -> None:
        if not request.url.startswith("data:"):
            self.requests.append(request.url)
