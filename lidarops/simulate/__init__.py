"""The lidar equation forward: raw files whose true extinction is known.

The modules follow the light:

1. Atmosphere: `atmosphere` (extinction and backscatter along a beam), `sun` (sky brightness),
   `mie` (scattering by spheres).
2. Signal: `overlap`, `signal` (short pulse), `pulse` (pulse of any shape), `lidar` (signal in W and
   MHz from physical units).
3. Detectors: `photoelectrons`, then `counting` (photon counter with dead time) and `analog`
   (digitiser).
4. Raw files: `dialects` (headers of real stations), `damage` (truncated, foreign and odd files),
   `planned_files` (names, times and places of the files), `files` (one file and its truth),
   `truth` (table of true values), `campaign` (all files of a campaign).

Start with `campaign.simulate_campaign` for a whole campaign, or `pulse.pulsed_signal` for one
signal.
"""

# Sets the cache of compiled code, whichever module is imported first.
import lidarops.retrieve  # noqa: F401
