"""What several test files share: toys, samples, rigs and scripted servers. No tests."""
