"""What is asked: cases, instances, schedules, and the sampler; no physics beyond the data."""
