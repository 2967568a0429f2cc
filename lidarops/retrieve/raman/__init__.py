"""Particle extinction, backscatter and lidar ratio from an elastic and a nitrogen Raman signal.

In this order (`retrieval.retrieve_raman`): signals over those of clean air, in cells; the smooth
optical depth of the Raman signal (`depth_fit`); its slope (`depth_fit`); the ratio of both
signals, calibrated in a reference window (`backscatter`); the lidar ratio, with the covariance
of both. No lidar ratio is assumed.
"""
