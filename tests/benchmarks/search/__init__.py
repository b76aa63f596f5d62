"""How good the search is: ARLBench's protocol with this project's methods (docs/search-benchmark.md)."""
