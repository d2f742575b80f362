"""What people read of the service: its pages, which need no internet, and its log."""

import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import urljoin

import pytest

REPOSITORY = Path(__file__).parents[2]
LOADED = re.compile(r"""(?:src|href)=["']([^"'#]+)["']|url\(([^)]+)\)|\burl: '([^']+)'""")


@pytest.mark.parametrize("page", ["/", "/docs"])
def test_a_page_loads_nothing_from_elsewhere(client, page):
    html = client.get(page).text
    found = {next(filter(None, groups)) for groups in LOADED.findall(html)}
    assert found
    for url in found - {"data:,"}:
        assert "//" not in url, url
        assert client.get(urljoin(page, url)).status_code == 200, url
    assert not re.findall(r"@import|https://", html)


def test_the_pages_load_only_what_is_served_and_only_as_files_of_their_own(client):
    seen, todo = set(), ["/", "/live/any"]
    while todo:
        url = todo.pop()
        if url in seen:
            continue
        seen.add(url)
        answer = client.get(url)
        assert answer.status_code == 200, url
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        if url.endswith(".js"):
            assert answer.headers["content-type"].startswith("text/javascript")
        text = answer.text
        assert not re.search(r"<script(?![^>]*src=)|<style|\bstyle=|\son\w+=", text), url
        assert not re.search(r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(", text), (
            url
        )
        found = re.findall(r"""(?:src|href)="((?:\.\./)?page/[^"]+)"|from '(\./[^']+)'""", text)
        todo += [urljoin(url, next(filter(None, groups))) for groups in found]
    modules = {url for url in seen if url.endswith(".js")}
    assert len(modules) > 10
    asked = "".join(client.get(page).text for page in ("/", "/live/any"))
    early = {
        f"/page/{name}" for name in re.findall(r'(?:preload" href|src)="[^"]*?([\w.]+js)"', asked)
    }
    assert early == modules  # none waits until another that imports it has come


def test_the_page_s_files_are_sent_once_and_named_plainly(client):
    first = client.get("/page/style.css")
    again = client.get("/page/style.css", headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    for name in ("..%2fapp.py", "nothing.js", "style.css%00", "%2e%2e%2fconfig.py"):
        assert client.get(f"/page/{name}").status_code == 404, name


def test_every_curl_fails_when_the_service_does():
    texts = [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/**/*.md")]
    texts += REPOSITORY.glob("service/**/*.html")
    lines = [line for path in texts for line in path.read_text("utf-8").splitlines()]
    commands = [line for line in lines if re.search(r"(^|>|\$ )curl ", line)]
    assert len(commands) >= 3
    assert [line for line in commands if "--fail-with-body" not in line] == []


def test_the_log_has_times_and_no_health_polls():
    code = """
import logging.config
from deepshade.serving import logging_config
logging.config.dictConfig(logging_config("info"))
for path in ("/healthz", "/readyz?x=1", "/metrics", "/shade/ao?radius=1"):
    logging.getLogger("uvicorn.access").info(
        '%s - "%s %s HTTP/%s" %d', "1.2.3.4:5", "GET", path, "1.1", 200)
logging.getLogger("deepshade.service").info("loaded")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    (line,) = done.stdout.splitlines()
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\S* .*GET /shade/ao", line)
    assert re.match(r"\d{4}-.* loaded", done.stderr)
