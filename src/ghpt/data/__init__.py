"""The only place that knows file formats and data sets."""
