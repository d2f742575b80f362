"""The trainer as a service: jobs that fine-tune a shader, and publish it only if it is better."""
