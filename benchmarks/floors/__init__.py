"""Code written by hand for one model or one family, to say how fast plain NumPy can be.

Nothing here imports bayesmc: a floor must stay comparable when the library changes.
"""
