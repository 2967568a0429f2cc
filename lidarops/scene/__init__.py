"""One scene: its plan, the signals of its channels, and the making of its products.

`pipe` holds the stages from raw counts to profiles in order, `case` what is known when they are
decided, `profiles` what they fill in. `retrieval` states what a kind of product adds: a decision,
and products in the making, and what several kinds decide alike. `plan` asks all of them,
`processing` carries the plan out. What one product depends on is what stands before it in the pipe,
or the products that it reads (`dependence`).
"""
