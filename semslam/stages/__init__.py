"""What is done to a log, one file a stage; `catalogue` lists them, `contract` says what a stage is."""
