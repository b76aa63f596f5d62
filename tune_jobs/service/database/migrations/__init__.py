"""The versions of the service's database, one after the other."""
