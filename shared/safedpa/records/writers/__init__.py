"""Writers: ``mcap`` records bus messages, ``tables`` writes runs and recordings as CSV or Parquet."""
