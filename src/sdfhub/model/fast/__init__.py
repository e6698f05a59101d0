"""What is fast, on a CPU first; a model computes the same without it, but for rounding.

What each buys in a step of SIREN / HOSC with Fourier features and normals (16 x 1024 samples, two cores that
were not idle): the loops in `waves` 1.4 / 1.5 x; micro-batches over threads (`pieces`, `side_by_side`)
1.8 / 1.4 x; keeping freed memory (`computing`) 1.6 / 1.1 x.
"""
