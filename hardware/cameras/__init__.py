"""Camera drivers behind one contract."""
