"""NVIDIA backend in Warp: float64 preparation per primitive, float32 pixels; the same source runs on Warp's CPU blocks,
for tests."""
