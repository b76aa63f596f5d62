"""The page: what the service shows in a browser, as files that are served as they are."""
