"""Makes .env, the secrets that docker-compose.yml reads: python3 deploy/env.py [--postgres].

Readable by its owner alone. One that is there is left as it is: its tokens are in use, and the
database keeps the password that it was made with. Needs nothing but Python 3.8.
"""

from __future__ import annotations

import argparse
import os
import secrets
import sys
from pathlib import Path

DATABASE = "postgresql+psycopg://deepshade:{password}@postgres/deepshade"


def settings(*, postgres: bool) -> dict[str, str]:
    """New tokens, 256 random bits each, by the names of their variables."""
    password = secrets.token_hex(32)
    made = {
        "DEEPSHADE_TOKEN": secrets.token_hex(32),
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "GRAFANA_PASSWORD": secrets.token_hex(16),
        "POSTGRES_PASSWORD": password,
        "DEEPSHADE_DATABASE": DATABASE.format(password=password) if postgres else "",
        "COMPOSE_PROFILES": "postgres" if postgres else "",
    }
    return made


def main(arguments: list[str] | None = None) -> int:
    """Write the file; 2 where it exists."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--postgres", action="store_true", help="jobs in PostgreSQL, not SQLite")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / ".env")
    asked = parser.parse_args(arguments)
    text = "".join(f"{k}={v}\n" for k, v in settings(postgres=asked.postgres).items())
    try:
        descriptor = os.open(asked.out, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        print(f"{asked.out} is there already; move it away for new tokens", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"can't write {asked.out}: {error.strerror}", file=sys.stderr)
        return 2
    with os.fdopen(descriptor, "w") as file:
        file.write(text)
    print(f"{asked.out}: new tokens for service, trainer, Ray, PostgreSQL and Grafana")
    return 0


if __name__ == "__main__":
    sys.exit(main())
