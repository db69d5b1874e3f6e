"""The numbers of the paper: for each a stateless function, and a torchmetrics ``Metric`` that sums it up."""
