"""Constants of nature and definition. The module imports nothing, so that its import is fast."""

STANDARD_GRAVITY_mps2 = 9.80665
