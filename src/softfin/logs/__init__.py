"""Recordings of a fin: the commands that excite it, logs as Parquet files, datasets as folders, their collection."""
