"""What finished runs show: read and pooled, as tables, figures and the report's page, beside published results."""
