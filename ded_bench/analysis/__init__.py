"""What rows mean: summary, timing, certificate, comparison, ablation."""
