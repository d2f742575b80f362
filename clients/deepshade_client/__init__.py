"""Python library and command line that talk to a deepshade service."""

from deepshade_client.answer import Answer, Saved
from deepshade_client.client import AsyncClient, Client
from deepshade_client.exceptions import (
    BadAnswer,
    BadRequest,
    Busy,
    ClientError,
    ConnectionBroken,
    ConnectionFailed,
    MissingAttribute,
    NotReady,
    ServerFailed,
    ServerProblem,
    TimedOut,
    TooLarge,
    TransportError,
)
from deepshade_client.mock import MockTransport, mock_answer
from deepshade_client.request import Options
from deepshade_client.settings import NO_RETRY, Retry, Timeout
from deepshade_client.trainer import Trainer

__all__ = [
    "NO_RETRY",
    "Answer",
    "AsyncClient",
    "BadAnswer",
    "BadRequest",
    "Busy",
    "Client",
    "ClientError",
    "ConnectionBroken",
    "ConnectionFailed",
    "MissingAttribute",
    "MockTransport",
    "NotReady",
    "Options",
    "Retry",
    "Saved",
    "ServerFailed",
    "ServerProblem",
    "TimedOut",
    "Timeout",
    "TooLarge",
    "Trainer",
    "TransportError",
    "mock_answer",
]
