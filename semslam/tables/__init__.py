"""Tables between the stages: `spec` says what they are (the twin of data_spec.md), `parquet` reads and writes them."""
