"""The pages in a real browser: what is seen is what the service answers, and what is said is so."""

from __future__ import annotations

import base64
import contextlib
import io
import itertools
import json
import re
import shutil
import subprocess
import threading
import time

import numpy as np
import pytest
from PIL import Image

from deepshade import exr, live, pictures

playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright: make setup")
websockets = pytest.importorskip("websockets.sync.client")
websockets_errors = pytest.importorskip("websockets.exceptions")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]
# pictures are drawn by the CPU, and nothing but the page is fetched
FLAGS = [
    *("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update"),
    "--disable-sync",
]
EXR = {"Content-Type": "image/x-exr"}
PATIENCE = 120_000  # ms: nothing here is about time, and machines are busy
playwright.expect.set_options(timeout=PATIENCE)


@pytest.fixture(scope="module")
def browser():
    # to be left before other tests begin: while it runs, asyncio has a loop in this thread
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def new_page(browser):
    """`new_page(**context options)`; what goes wrong in it fails the test."""
    pages, wrong = [], []

    def new(**options):
        context = browser.new_context(**({"viewport": {"width": 900, "height": 560}} | options))
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("dialog", lambda dialog: wrong.append(f"dialog: {dialog.message}"))
        page.on("console", lambda m: m.type == "error" and note(m))
        pages.append(page)
        return page

    def note(message):  # refusals that a test provokes are logged by the browser too
        if not re.search(r"status of 4\d\d|ERR_CONNECTION|WebSocket connection", message.text):
            wrong.append(message.text)

    yield new
    for page in pages:
        page.context.close()
    assert wrong == []


@pytest.fixture
def opened(new_page, client, tmp_path, make_exr, make_picture):
    """(the page, having shaded a file of its own; that file)."""
    ramp = np.linspace(0, 1.5, 48 * 64, dtype=np.float32).reshape(48, 64)
    light = {"light.R": ramp, "light.G": ramp[::-1], "light.B": ramp**2}
    path = tmp_path / "shot one.exr"
    path.write_bytes(make_exr(make_picture(48, 64) | light))
    page = new_page()
    page.goto(str(client.base_url))
    answered(page)
    page.locator("#files").set_input_files(path)
    page.locator("#title", has_text="shot one.exr").wait_for()
    answered(page)
    return page, path


def answered(page):
    """Wait until nothing is under way and an answer is there."""
    page.locator("#download:enabled").wait_for()
    page.locator("#progress").wait_for(state="hidden")


def shows(page, wanted):
    """Whether the picture is seen as these (H, W, 3) 8-bit values, a pixel a pixel, but for what
    rounding does; in the middle of the canvas, whose sides may be odd."""
    height, width = wanted.shape[:2]
    for _ in range(20):  # a browser that is starved takes some time to draw
        page.locator("#canvas").press("0")
        page.locator("#canvas").press("1")
        shown = Image.open(io.BytesIO(page.locator("#canvas").screenshot())).convert("RGB")
        left, top = (shown.width - width) // 2, (shown.height - height) // 2
        for y, x in itertools.product((top, top + 1), (left, left + 1)):
            seen = np.asarray(shown, int)[y : y + height, x : x + width]
            if np.abs(seen - wanted).max() <= 1:
                return True
    return False


def answer_of(client, path, **query):
    got = client.post("/shade/ao", params=query, content=path.read_bytes(), headers=EXR)
    assert got.status_code == 200
    return got.content


def test_what_is_seen_is_what_the_service_answers(opened, client):
    page, path = opened
    page.locator("#canvas").press("a")
    wanted = exr.read(answer_of(client, path)).pixels["Y"]
    assert shows(page, pictures.shading(wanted))
    page.locator("#canvas").press("]")  # a third of a stop
    assert shows(page, pictures.shading(wanted * 2 ** (1 / 3)))
    page.get_by_label("Picture B").select_option(label="light")
    page.locator("#canvas").press("b")
    light = exr.read(path, ["light.R", "light.G", "light.B"]).stack(
        ["light.R", "light.G", "light.B"]
    )
    assert shows(page, pictures.srgb(light * 2 ** (1 / 3)))


def test_values_under_the_cursor_are_those_of_the_file(opened, client):
    page, path = opened
    page.locator("#canvas").press("ArrowRight")
    page.locator("#canvas").press("ArrowDown")
    text = page.locator("#values").text_content()
    x, y, value = re.match(r"(\d+), (\d+)\s+A (\S+)", text).groups()
    wanted = exr.read(answer_of(client, path)).pixels["Y"][int(y), int(x)]
    assert float(value) == pytest.approx(float(wanted), rel=1e-3)


def test_a_changed_setting_shades_anew_without_sending_the_file_again(opened, client):
    page, path = opened
    sent = []
    page.on("request", lambda request: sent.append(request.url.split("/")[-1].partition("?")[0]))
    before = page.locator("#timing").text_content()
    page.get_by_label("Radius", exact=True).fill("0.9")
    page.get_by_label("Radius", exact=True).press("Enter")
    playwright.expect(page.locator("#timing")).not_to_have_text(before)
    assert sent == ["ao"]
    page.locator("#canvas").press("a")
    wanted = exr.read(answer_of(client, path, radius=0.9)).pixels["Y"]
    assert shows(page, pictures.shading(wanted))


def test_an_upload_that_is_gone_is_sent_again_by_the_page(opened, service):
    page, _ = opened
    service.service.kept._entries.clear()
    sent = []
    page.on("request", lambda request: sent.append(f"{request.method} {request.url}"))
    before = page.locator("#timing").text_content()
    page.get_by_label("Radius", exact=True).fill("0.7")
    page.get_by_label("Radius", exact=True).press("Enter")
    playwright.expect(page.locator("#timing")).not_to_have_text(before)
    assert len([each for each in sent if each.endswith("/uploads")]) == 1
    assert page.locator("#problem").is_hidden()


def test_what_is_taken_along_is_the_answer_and_the_copied_line_gives_it_too(opened, client):
    page, path = opened
    page.get_by_label("Radius", exact=True).fill("0.8")
    page.get_by_label("Radius", exact=True).press("Enter")
    wanted = answer_of(client, path, radius=0.8)
    with page.expect_download() as download:
        page.locator("#download").click()
    assert download.value.suggested_filename == "shot one_ao.exr"
    assert download.value.path().read_bytes() == wanted
    page.locator("#curl").click()
    command = page.locator("#snippet").text_content()
    subprocess.run(["sh", "-c", command], cwd=path.parent, check=True, capture_output=True)
    assert (path.parent / "shot one_ao.exr").read_bytes() == wanted
    page.locator("#python").click()
    code = page.locator("#snippet").text_content()
    compile(code, "snippet", "exec")
    assert "Options(radius=0.8)" in code


def test_a_hostile_name_is_text_and_never_part_of_a_command(new_page, client, make_exr):
    name = "<img src=x onerror=alert(1)>'$(touch pwned)`\"\u202egnp.exr"
    page = new_page()
    page.goto(str(client.base_url))
    answered(page)
    page.evaluate(
        """([name, data]) => {
          const files = new DataTransfer();
          const bytes = Uint8Array.from(atob(data), c => c.charCodeAt(0));
          files.items.add(new File([bytes], name));
          dispatchEvent(new DragEvent('drop', {dataTransfer: files, cancelable: true}));
        }""",
        [name, base64.b64encode(make_exr(32, 48)).decode()],
    )
    page.locator("#title", has_text="onerror").wait_for()
    answered(page)
    assert page.locator("#title").text_content() == name.replace("\u202e", "\ufffd")
    assert page.locator("header img, .panel section img:not(.thumbnail)").count() == 0
    page.locator("#curl").click()
    assert "input.exr" in page.locator("#snippet").text_content()  # not what it is not


def test_what_is_wrong_with_a_file_is_said_with_what_to_do(new_page, client, tmp_path, make_exr):
    page = new_page()
    page.goto(str(client.base_url))
    answered(page)
    bad = tmp_path / "bad.exr"
    bad.write_bytes(b"no EXR at all")
    page.locator("#files").set_input_files(bad)
    page.locator("#problem", has_text="not an OpenEXR image").wait_for()
    bad.write_bytes(
        make_exr({"R": np.ones((16, 16)), "G": np.ones((16, 16)), "B": np.ones((16, 16))})
    )
    page.locator("#files").set_input_files(bad)
    page.locator("#lacks", has_text="normal").wait_for()
    assert page.locator("#download").is_disabled()


@pytest.mark.parametrize("width", [360, 1440])
@pytest.mark.parametrize("path", ["/", "/live/nothing-here"])
def test_it_fits_and_every_control_has_a_name(new_page, client, width, path):
    page = new_page(viewport={"width": width, "height": 740})
    page.goto(f"{client.base_url}{path}".replace("//live", "/live"))
    page.locator("#zoom button").first.wait_for()
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    nameless = page.evaluate(
        """() => [...document.querySelectorAll('button, select, input, [role=slider], canvas')]
          .filter(e => !e.getAttribute('aria-label') && !e.labels?.length && !e.textContent.trim())
          .map(e => e.outerHTML)"""
    )
    assert nameless == []


def test_without_webgl_the_page_says_so_and_still_shades(new_page, client):
    page = new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(str(client.base_url))
    page.locator("#nothing", has_text="WebGL2").wait_for()
    answered(page)


class Publisher:
    """Streams pictures whose answers are known, as docs/streaming.md says."""

    def __init__(self, service, name, resume=None):
        url = f"ws://127.0.0.1:{service.address[1]}/live/{name}/publish"
        self._context = websockets.connect(url, subprotocols=["deepshade.live.1"], compression=None)
        self.socket = self._context.__enter__()
        hello = {"type": "hello", "protocol": 1, "effects": "ao", "answers": "none"}
        self.socket.send(json.dumps(hello | {"settings": {"radius": 0.5}, "resume": resume}))
        self.resume = json.loads(self.socket.recv())["resume"]
        threading.Thread(target=self._listen, daemon=True).start()
        self.id = 0

    def _listen(self):
        with contextlib.suppress(OSError, websockets_errors.ConnectionClosed):
            for message in self.socket:
                said = json.loads(message) if isinstance(message, str) else {}
                if said.get("type") == "ping":
                    pong = {"type": "pong", "t": said["t"], "clock": time.time()}
                    self.socket.send(json.dumps(pong))

    def send(self, channels):
        self.id += 1
        planes = {name: plane.astype(np.float32) for name, plane in channels.items()}
        now = time.time()
        frame = live.pack(
            live.GBUFFER, self.id, planes, {"header": {}}, codec="raw", time=now, sent=now
        )
        self.socket.send(frame)

    def vanish(self):
        self.socket.socket.close()

    def end(self):
        self.socket.send(json.dumps({"type": "end"}))
        self._context.__exit__(None, None, None)


def test_a_stream_is_seen_ends_up_at_its_last_frame_and_is_said_to_stand_still(
    new_page, service, client, make_picture, make_exr, tmp_path
):
    page = new_page()
    page.goto(f"{str(client.base_url).rstrip('/')}/live/shot")
    page.locator("#badge", has_text="No session").wait_for()
    frames = [make_picture(48, 64, seed) for seed in range(12)]
    publisher = Publisher(service, "shot")
    for frame in frames:  # faster than a browser without graphics draws: most are dropped
        publisher.send(frame)
        time.sleep(0.03)
    page.locator("#badge", has_text="At rest").wait_for()
    path = tmp_path / "last.exr"
    path.write_bytes(make_exr(frames[-1]))
    wanted = pictures.shading(exr.read(answer_of(client, path, radius=0.5)).pixels["Y"])
    assert shows(page, wanted)  # exact, no JPEG
    assert re.match(r"\d", page.locator("#age").text_content())
    publisher.vanish()
    page.locator("#badge", has_text="the publisher has gone").wait_for()
    assert page.locator("body").get_attribute("data-state") == "frozen"
    assert "grayscale" in page.evaluate(
        "getComputedStyle(document.querySelector('#canvas')).filter"
    )
    back = Publisher(service, "shot", publisher.resume)
    back.id = publisher.id
    back.send(frames[0])
    playwright.expect(page.locator("body")).not_to_have_attribute("data-state", "frozen")
    assert "publisher is back" in page.locator("#log").text_content()
    back.end()
    page.locator("#badge", has_text="No session").wait_for()


def test_a_service_that_is_killed_is_said_to_be_gone_and_is_found_again(
    new_page, start_server, make_exr
):
    first = start_server()
    port = first.url.rsplit(":", 1)[1]
    watching, shading = new_page(), new_page()
    watching.goto(f"{first.url}/live/shot")
    shading.goto(first.url)
    watching.locator("#badge", has_text="No session").wait_for()
    answered(shading)
    first.stop(9)
    watching.locator("#badge", has_text="does not answer").wait_for()
    shading.get_by_label("Radius", exact=True).fill("0.9")
    shading.get_by_label("Radius", exact=True).press("Enter")
    shading.locator("#problem", has_text="doesn't answer").wait_for()
    start_server("--port", port)
    watching.locator("#badge", has_text="No session").wait_for()
    shading.locator("#problem").wait_for(state="hidden")
