"""What studies share: their scale, data sets, rows, training curves and drawing."""
