//! What rpc offers, for the program that holds the run: the same requests and answers, without a socket.

use std::sync::Arc;

use super::service::Service;
use crate::rpc::api::{Backend, Method, Reply, Request};
use crate::rpc::server::CALL_LIMIT;
use crate::rpc::{Code, RpcError};

/// Asks all of it at once and waits for all answers, which come in the order of the requests.
pub fn call<M: Method>(service: &Arc<Service>, requests: &[M]) -> Vec<Result<M::Reply, RpcError>> {
    let requests: Vec<_> = requests.iter().map(typed).collect();
    let answers = if tokio::runtime::Handle::try_current().is_err() {
        wait_for(service, requests)
    } else {
        // On a thread of an async program, which cannot wait for a second one.
        std::thread::scope(|scope| scope.spawn(|| wait_for(service, requests)).join()).unwrap_or_default()
    };
    answers.into_iter().map(|answer| answer.and_then(reply::<M>)).collect()
}

fn wait_for(service: &Arc<Service>, requests: Vec<Result<Request, RpcError>>) -> Vec<Result<Reply, RpcError>> {
    let runtime = match tokio::runtime::Builder::new_current_thread().enable_time().build() {
        Ok(runtime) => runtime,
        Err(e) => return requests.iter().map(|_| Err(defect(&e.to_string()))).collect(),
    };
    runtime.block_on(async {
        let begin = |request: Result<Request, RpcError>| {
            let service = service.clone();
            tokio::spawn(
                async move { tokio::time::timeout(CALL_LIMIT, service.call(request?)).await.unwrap_or_else(late) },
            )
        };
        let begun: Vec<_> = requests.into_iter().map(begin).collect();
        let mut answers = Vec::with_capacity(begun.len());
        for answer in begun {
            answers.push(answer.await.unwrap_or_else(|e| Err(defect(&e.to_string()))));
        }
        answers
    })
}

fn late(_: tokio::time::error::Elapsed) -> Result<Reply, RpcError> {
    let what = format!("the run did not answer within {} s", CALL_LIMIT.as_secs());
    Err(RpcError::new(Code::NoAnswer, what).hint("the request may still take effect"))
}

/// The request as the service takes it, checked like one that came over the socket.
fn typed<M: Method>(request: &M) -> Result<Request, RpcError> {
    request.check().map_err(|what| RpcError::new(Code::InvalidParams, format!("params of {:?}: {what}", M::NAME)))?;
    Request::read(M::NAME, serde_json::to_value(request).map_err(|e| defect(&e.to_string()))?)
}

fn reply<M: Method>(reply: Reply) -> Result<M::Reply, RpcError> {
    serde_json::to_value(reply).and_then(serde_json::from_value).map_err(|e| defect(&e.to_string()))
}

/// What cannot happen, happened.
pub fn defect(what: &str) -> RpcError {
    RpcError::new(Code::Internal, format!("a defect of the program: {what}"))
}
