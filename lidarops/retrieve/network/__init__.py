"""Extinction and visibility where the beams of several lidars cross.

The order of the retrieval, and the modules that do it:

1. `geometry`: stations and pointings give beams, and the crossings where beams meet.
2. `_beam_signals`: the signals are validated, and those that noise hides are left out.
3. `_condensed_signals`: outlying bins are bridged (`outlying_bins`). Each beam is
   condensed to its signal at the crossings and the integrals between them, with their covariance.
4. `_beam_fit`: all beams are solved together for all crossings.
5. `_changing_field`: the prior of the mean field, and how it changes within a block.
6. `_block_solution`: the powers of a block are averaged, and its profiles are solved as one field.
7. `extinction_field`: `retrieve_network` runs these steps and flags the values.

`labeled` runs the retrieval on xarray data and adds the errors that all bins of a beam share.
"""
