"""Extinction and visibility where the beams of several lidars cross.

The order of the retrieval, and the modules that do it:

1. `geometry`: stations and pointings give beams, and the crossings where beams meet.
2. `_beam_signals`: the signals are validated, and those that noise hides are left out.
3. `_condensed_signals`: outlying bins are bridged (`outlying_bins`). Each beam is
   condensed to its signal at the crossings and the integrals between them, with their covariance.
4. `_joint_solution`: all beams of a profile are solved together for all crossings.
5. `_empirical_prior`: each block chooses the prior of ln extinction over the crossings.
6. `_block_errors`: the block adds errors that one profile cannot see.
7. `extinction_field`: `retrieve_network` runs these steps and flags the values.

`labeled` runs the retrieval on xarray data and adds the errors that all bins of a beam share.
"""
