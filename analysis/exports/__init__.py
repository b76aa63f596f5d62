"""A sweep for other programs and for papers: tables of its trials, evaluations and settings, and figures."""
