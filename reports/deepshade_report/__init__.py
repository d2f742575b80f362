"""Speed against error, measured on the machine it runs on: `deepshade report`."""
