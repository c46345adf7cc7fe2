//! The JSON Schema of the protocol: parameters and reply of every method, data of every stream, errors.

use schemars::{JsonSchema, Schema, SchemaGenerator, generate::SchemaSettings};
use serde_json::{Map, Value, json};

use crate::api::{
    Lease, Method, OnBehalfOf, PLANNER_REQUESTS, PlannerAnswer, PlannerRequest, RECHECK, Recheck, RecheckReply,
    RegisterGateway, RegisterPlanner, Release, method_schemas,
};
use crate::error::RpcError;
use crate::server::streams::{EventReport, JointState, Stream, Subscribe, Unsubscribe};

/// Schemas of one method.
pub(crate) struct MethodSchema {
    name: &'static str,
    params: Schema,
    result: Schema,
}

impl MethodSchema {
    /// Returns the schemas of the method with parameters `M`.
    pub fn of<M: Method>(generator: &mut SchemaGenerator) -> Self {
        Self::named::<M, M::Reply>(M::NAME, generator)
    }

    fn named<P: JsonSchema, R: JsonSchema>(name: &'static str, generator: &mut SchemaGenerator) -> Self {
        Self { name, params: generator.subschema_for::<P>(), result: generator.subschema_for::<R>() }
    }
}

/// Returns the JSON Schema (draft 2020-12) of the protocol: `methods` with their `params` and `result`, `streams` with
/// their `data`, `planner_requests` (methods that only a run sends to an attached planner), `error`, and the types that
/// they refer to in `$defs`.
pub fn json_schema() -> Value {
    let mut generator = SchemaSettings::draft2020_12().into_generator();
    let g = &mut generator;
    let mut methods = method_schemas(g);
    // The methods that the connection itself answers.
    methods.extend([
        MethodSchema::of::<Subscribe>(g),
        MethodSchema::of::<Unsubscribe>(g),
        MethodSchema::of::<Lease>(g),
        MethodSchema::of::<Release>(g),
        MethodSchema::of::<RegisterPlanner>(g),
        MethodSchema::of::<PlannerAnswer>(g),
        MethodSchema::of::<OnBehalfOf>(g),
        MethodSchema::of::<RegisterGateway>(g),
    ]);
    let planner_requests = [MethodSchema::named::<Recheck, RecheckReply>(RECHECK, g)];
    let streams = json!({
        (Stream::CoordinatorJointState.name()): { "data": g.subschema_for::<JointState>() },
        (Stream::Events.name()): { "data": g.subschema_for::<EventReport>() },
        PLANNER_REQUESTS: { "data": g.subschema_for::<PlannerRequest>() },
    });
    let error = g.subschema_for::<RpcError>();
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "dimos rpc",
        "methods": table(methods),
        "streams": streams,
        "planner_requests": table(planner_requests),
        "error": error,
        "$defs": generator.take_definitions(true),
    })
}

fn table(methods: impl IntoIterator<Item = MethodSchema>) -> Value {
    let row = |method: MethodSchema| {
        let MethodSchema { name, params, result } = method;
        (name.to_owned(), json!({ "params": params, "result": result }))
    };
    Value::Object(methods.into_iter().map(row).collect::<Map<_, _>>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::api::METHODS;

    #[test]
    fn every_method_has_parameters_and_a_reply() {
        let schema = json_schema();
        for method in METHODS {
            for part in ["params", "result"] {
                let found = &schema["methods"][method][part];
                assert!(found.is_object(), "{method}: no {part}");
            }
        }
        assert_eq!(schema["methods"].as_object().unwrap().len(), METHODS.len());
    }

    #[test]
    fn every_reference_has_a_definition() {
        fn references(value: &Value, found: &mut Vec<String>) {
            match value {
                Value::Object(map) => {
                    found.extend(map.get("$ref").and_then(Value::as_str).map(str::to_owned));
                    map.values().for_each(|value| references(value, found));
                }
                Value::Array(list) => list.iter().for_each(|value| references(value, found)),
                _ => {}
            }
        }
        let (schema, mut found) = (json_schema(), Vec::new());
        references(&schema, &mut found);
        assert!(found.len() > 50, "{found:?}");
        for reference in found {
            let pointer = reference.strip_prefix('#').unwrap();
            assert!(schema.pointer(pointer).is_some(), "{reference}");
        }
    }
}
