"""How soon the pages show a picture, in a browser that draws on the CPU, beside opening a text.

Opens each several times, a fresh context each time so that nothing is in a cache, and takes the
time from the navigation's start to the first picture that is drawn. Needs Chromium and a service:

    deepshade serve & python benchmarks/page.py http://127.0.0.1:8000 --session shot
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics

from playwright.sync_api import Browser, sync_playwright

from deepshade.machine import describe

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def opened_ms(browser: Browser, url: str) -> dict[str, float]:
    """Milliseconds from the navigation's start: the document is there; the first picture is drawn.

    A document without pictures has no second time.
    """
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    page = context.new_page()
    page.goto(url)
    times = page.evaluate(
        """async () => {
          const document_ms = performance.getEntriesByType('navigation')[0].domInteractive;
          if (!window.document.querySelector('#canvas')) return {document_ms};
          for (let turn = 0; turn < 600; turn++) {
            const [mark] = performance.getEntriesByName('first picture');
            if (mark) return {document_ms, picture_ms: mark.startTime};
            await new Promise(resolve => setTimeout(resolve, 50));
          }
          return {document_ms};
        }"""
    )
    context.close()
    return dict(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("server", nargs="?", default="http://127.0.0.1:8000")
    parser.add_argument("--session", help="a live session that is being published to")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    pages = {"text": "/healthz", "page": "/"}
    if arguments.session:
        pages["live"] = f"/live/{arguments.session}"
    found: dict[str, list[dict[str, float]]] = {name: [] for name in pages}
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium") or shutil.which("chromium-browser"), args=FLAGS
        )
        opened_ms(browser, arguments.server + "/healthz")  # the browser itself starts
        for _ in range(arguments.rounds):
            for name, path in pages.items():
                found[name].append(opened_ms(browser, arguments.server + path))
        browser.close()
    medians = {
        name: {key: round(statistics.median(each[key] for each in times), 1) for key in times[0]}
        for name, times in found.items()
    }
    print(json.dumps({"machine": describe(), "medians": medians}, indent=2))


if __name__ == "__main__":
    main()
