"""The lidar equation forward: raw files whose true extinction is known.

The modules follow the light:

1. `atmosphere`: extinction and backscatter along a beam, brightness of the sky.
2. Signal: `signal` (overlap, short pulse), `pulse` (pulse of any shape).
3. Detectors: `counting` (photoelectrons, photon counter with dead time), `analog` (digitiser).
4. Raw files: `damage` (truncated, foreign and odd files), `planned_files` (names, times, places and
   header dialects of the files), `files` (one file and its truth), `truth` (table of true values),
   `campaign` (all files of a campaign).

Start with `campaign.simulate_campaign` for a whole campaign, or `pulse.pulsed_signal` for one
signal.
"""

# Sets the cache of compiled code, whichever module is imported first.
import lidarops.retrieve.common  # noqa: F401
