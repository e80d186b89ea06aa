"""Many gateways: a cluster of brokers to try, an overview of all of them, an archive of what they sent."""
