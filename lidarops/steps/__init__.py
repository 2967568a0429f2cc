"""The steps from raw counts to signals that several kinds of product share, and what a step is.

`step` defines a step, `case` what its decision sees, `data` what it works on. `registry` finds the
steps of every kind of product, and what one product needs of a plan follows from their inputs and
outputs (`dependence`).
"""
