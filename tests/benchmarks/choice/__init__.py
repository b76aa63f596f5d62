"""The benchmark of the choice: which rule names a setting that is good on seeds it has not seen."""
