"""What is measured of a dot: names of the columns and of the outcomes.

Columns ``U`` to ``LOPSIDED_NOISE``: centre [px]; its covariance under white noise of variance 1 [px²]; area [px²];
ellipse matrix (dᵀQd = 1 on the edge); contrast and noise variance of the surroundings [grey levels, squared]; amplitude
of the odd harmonics (first and third) of the edge's level around the dot, 0 for whole dots whatever their blur, and
its rms under unit noise.

``BXX`` to ``BYY``: the part of the covariance that comes from the dot's own light, so that noise of variance ``NOISE``
on black and ``BRIGHT`` on white gives NOISE (C - B) + BRIGHT B. ``BRIGHT`` [levels²]: noise inside the dot, -1 where
the dot is too small to see it. ``BACKGROUND`` [levels] under the centre; ``FLUX`` [levels px]: the dot's light above
it, ``FLUX_NOISE`` its rms under unit noise.

``LIT`` (2, 2) [px²]: shift of the centre by a relative slope of the contrast [1/px]; ``DARK`` (2, 2) [px²/level]: by a
slope of the background [levels/px]. ``SLOPE`` (2,) [1/px]: relative slope of the dot's inner level, ``SLOPE_XX`` to
``SLOPE_YY`` its covariance under unit noise, ``PULL`` (2, 2) that of centre and slope. ``EXX`` to ``EYY`` [px²]:
covariance beside the noise's, of the light and of what is odd about the dot.
"""

U, V, CXX, CXY, CYY, AREA, QXX, QXY, QYY, CONTRAST, NOISE, LOPSIDED, LOPSIDED_NOISE = range(13)
BXX, BXY, BYY, BRIGHT, BACKGROUND, FLUX, FLUX_NOISE = range(13, 20)
LIT, DARK, SLOPE, SLOPE_XX, SLOPE_XY, SLOPE_YY, PULL, EXX, EXY, EYY = 20, 24, 28, 30, 31, 32, 33, 37, 38, 39
FIELDS = 40

OK, NO_CONTRAST, NO_COMPONENT, BORDER, SHAPE, DIVERGED = range(6)
