"""Live streams: sources of frames, a publisher that sends them, sinks for what comes back."""

from deepshade_client.live.pictures import LiveAnswer, Picture
from deepshade_client.live.publisher import Event, Publisher

__all__ = ["Event", "LiveAnswer", "Picture", "Publisher"]
