"""Data reduction and drawing of products, for the report and the site.

Two layers of modules:

- Data reduction, without matplotlib: ``*_data.py`` take what a figure shows out of a product, as
  plain arrays; ``raster.py`` reduces images to block means; ``time_axis.py`` lays out time axes;
  ``reading.py`` reads products in parallel; ``wording.py`` formats numbers and names. The report
  and the site both use these modules.
- Drawing with matplotlib: ``panels.py`` and ``*_panels.py`` draw into one panel,
  ``*_figures.py`` compose panels to figures, ``charts.py`` draws the charts of benchmarks. The
  report uses these modules; the site draws SVG of its own (`lidarops.site.svg`).
"""
