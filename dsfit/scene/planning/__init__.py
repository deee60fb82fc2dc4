"""Proven bounds on the terms of the integrand, from interval arithmetic and the monotony of their parts.

Every quantity is enclosed on small cells of its argument (`RangeTable`), and integrals over theta_h are bounded by
upper and lower sums over cells, with the mass of each Gaussian exact. Nothing is sampled: the bounds hold at every
direction.
"""
