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


def test_the_page_names_no_command_line_option_but_curl_s(client):
    assert re.findall(r"--[a-z-]+", client.get("/").text) == ["--fail-with-body", "--data-binary"]


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
