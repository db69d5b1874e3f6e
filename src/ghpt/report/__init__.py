"""Tables, figures, Markdown, TensorBoard."""
