"""Fine-tuning a bundle to views of one's own, and the decision whether that made it better."""
