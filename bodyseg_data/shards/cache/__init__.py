"""Cache of remote shards in a folder of bounded size."""
