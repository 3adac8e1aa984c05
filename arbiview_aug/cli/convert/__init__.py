"""Offline conversion: a whole data set as another vehicle's cameras would have recorded it, in the source's format."""
