"""Pages in a browser, and what they do that they should not."""

from typing import Any

DESKTOP = {"width": 1280, "height": 900}


class Window:
    """A page; ``wrong`` has its errors, and its requests of anything but local pages, ``dialogs`` what it asks.

    Args:
        browser: what opens it.
        options: of the browser's context.

    """

    def __init__(self, browser: Any, **options: Any) -> None:
        self.context = browser.new_context(**({"viewport": DESKTOP} | options))
        self.page = self.context.new_page()
        self.wrong: list[str] = []
        self.dialogs: list[str] = []
        self.page.on("console", lambda message: self.wrong.append(message.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("dialog", lambda dialog: (self.dialogs.append(dialog.message), dialog.dismiss()))
        self.page.on("request", lambda request: None if _harmless(request.url) else self.wrong.append(request.url))

    def settle(self) -> None:
        """Wait until what was asked for is drawn."""
        self.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def press(self, *keys: str) -> None:
        """Press keys one after the other."""
        for key in keys:
            self.page.keyboard.press(key)

    def close(self) -> None:
        """Close the page, which must have done nothing wrong."""
        self.context.close()
        assert self.wrong == self.dialogs == []


def _harmless(url: str) -> bool:
    return url.startswith(("data:", "blob:", "about:")) or (url.startswith("file:") and ".html" in url)
