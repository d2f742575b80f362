"""Whether a service answers, for health checks of containers: python -m deepshade.health URL.

Sends $DEEPSHADE_TOKEN. Exit code 0 for an answer in the 200s, 1 for any other and for none.
"""

from __future__ import annotations

import os
import sys
import urllib.request

TIMEOUT = 4.0  # seconds


def problem(url: str) -> str:
    """What is wrong with the service at a URL; empty where it is well."""
    try:
        request = urllib.request.Request(url)
        if token := os.environ.get("DEEPSHADE_TOKEN"):
            request.add_header("Authorization", f"Bearer {token}")
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(request, timeout=TIMEOUT):
            return ""
    except (OSError, ValueError) as error:  # HTTPError is an OSError
        return f"{url}: {error}"


def main(arguments: list[str]) -> int:
    """Print what is wrong."""
    if len(arguments) != 1:
        print("usage: python -m deepshade.health URL", file=sys.stderr)
        return 2
    if found := problem(arguments[0]):
        print(found, file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
