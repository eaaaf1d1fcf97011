"""A picture of the viewer at a held-out view, for docs/viewer.md. Needs viser, Playwright and Chromium or Chrome on the
PATH.

python docs/make_viewer_picture.py RUN_DIR docs/pictures/viewer.png [VIEW]
"""

from __future__ import annotations

import io
import shutil
import sys
import threading
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from neuprim.config.command_settings import ViewerSettings
from neuprim.viewer.view import view_run

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SIZE = {"width": 1120, "height": 680}
WAIT = 6000  # milliseconds until all is drawn


def picture(address: str, browser: str, view: int) -> Image.Image:
    """Of the window after a jump to a held-out view, by its number."""
    with sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=browser, args=list(FLAGS))
        page = started.new_page(viewport=SIZE)
        page.goto(address)
        page.wait_for_timeout(WAIT)
        page.get_by_label("held-out view", exact=True).click()
        page.get_by_role("option").nth(1 + view).click()
        for button in page.locator(".mantine-Notification-closeButton").all():
            button.click()  # what viser says of browsers that draw in software
        page.wait_for_timeout(WAIT)
        shot = page.screenshot()
        started.close()
    return Image.open(io.BytesIO(shot)).convert("RGB")


def main(run: Path, target: Path, view: int = 0) -> None:
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        sys.exit(f"needs one of {', '.join(BROWSERS)} on the PATH")
    end, opened, addresses = threading.Event(), threading.Event(), list[str]()

    def told(address: str) -> None:
        addresses.append(address)
        opened.set()

    thread = threading.Thread(target=view_run, args=(run, ViewerSettings(port=0), told), kwargs={"end": end})
    thread.start()
    try:
        while not opened.wait(1.0):
            if not thread.is_alive():
                sys.exit(1)  # it has said why
        picture(addresses[0], browser, view).save(target, optimize=True)
    finally:
        end.set()
        thread.join()


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
