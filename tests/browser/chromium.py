"""A headless Chromium without a network, driven by Playwright."""

from __future__ import annotations

import shutil
from importlib.util import find_spec
from typing import Any, Self

#: The browser's executable.
PROGRAM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))),
    None,
)
#: The reason why no browser is available, or an empty string.
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
    # no host except this machine is resolved
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
]


class Browser:
    """A browser with one page; use it as a context manager.

    Attributes:
        page: Playwright's page.
        complaints: errors and warnings of the console, uncaught exceptions, failed requests.
        requests: addresses of requests, except data URLs.
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

    def __exit__(self, *_: object) -> None:
        self._chromium.close()
        self._playwright.stop()

    def _new_page(self, **options: Any) -> None:
        self.page = self._chromium.new_page(**options)
        self.page.on("console", self._log_message)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", self._log_request)

    def open(
        self, address: str, width: int = 1200, height: int = 900, *, motion: bool = True
    ) -> None:
        """Load a page in a new window and clear the logs.

        Args:
            width, height: of the window, px.
            motion: False if the user prefers reduced motion.
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
        """The value of a JavaScript expression, after a promise is resolved."""
        return self.page.evaluate(expression)

    def press(self, key: str) -> None:
        """Press and release a key."""
        self.page.keyboard.press(key)

    def _log_message(self, message: Any) -> None:
        if message.type in ("error", "warning", "assert"):
            self.complaints.append(message.text)

    def _log_request(self, request: Any) -> None:
        if not request.url.startswith("data:"):
            self.requests.append(request.url)
