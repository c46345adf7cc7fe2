"""Reads metrics (stdin) with Prometheus' own parser of OpenMetrics: one JSON object of all samples and their types."""

import json
import sys

from prometheus_client.openmetrics.parser import text_string_to_metric_families

families = text_string_to_metric_families(sys.stdin.read())
print(
    json.dumps(
        {
            family.name: {
                "type": family.type,
                "unit": family.unit,
                "samples": [[sample.name, sample.labels, sample.value] for sample in family.samples],
            }
            for family in families
        }
    )
)
