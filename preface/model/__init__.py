"""The prior: encodings, step functions, volume rendering, losses and networks of a Mip-NeRF 360 auto-decoder."""
