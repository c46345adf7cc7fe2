//! Rpc calls within the program that holds the run: the same requests and replies, without socket and JSON.

use std::future::poll_fn;
use std::sync::{Arc, LazyLock};
use std::task::Poll;

use tokio::runtime::{Builder, Handle, Runtime};

use crate::runtime::Service;
use dimos_core::telemetry::Origin;
use dimos_rpc::api::{METHODS, Method, Reply, Request};
use dimos_rpc::server::CALL_TIMEOUT;
use dimos_rpc::{Code, RpcError};

/// The runtime of all calls in this process. It has no threads: each call runs on the calling thread.
static RUNTIME: LazyLock<std::io::Result<Runtime>> =
    LazyLock::new(|| Builder::new_current_thread().enable_time().build());

/// Sends all requests at once and waits for all replies. Returns them in the order of the requests. `epoch`: that of
/// the requests; `None`: the present one.
pub fn call<M: Method>(service: &Arc<Service>, epoch: Option<u64>, requests: &[M]) -> Vec<Result<M::Reply, RpcError>> {
    let requests: Vec<_> = requests.iter().map(typed).collect();
    let failed: Vec<_> = requests.iter().map(|_| Err(defect("no answer"))).collect();
    let answers =
        wait_for(ask(service, Origin { epoch: epoch.unwrap_or_else(|| service.tick.epoch()), client: 0 }, requests))
            .unwrap_or(failed);
    answers.into_iter().map(|answer| answer.and_then(reply::<M>)).collect()
}

/// Waits for a future on this thread; `None` if the runtime cannot be created.
pub fn wait_for<T: Send>(something: impl Future<Output = T> + Send) -> Option<T> {
    let runtime = RUNTIME.as_ref().ok()?;
    if Handle::try_current().is_err() {
        return Some(runtime.block_on(something));
    }
    // A thread of an async runtime cannot block on a second one.
    std::thread::scope(|scope| scope.spawn(|| runtime.block_on(something)).join().ok())
}

async fn ask(
    service: &Arc<Service>,
    origin: Origin,
    requests: Vec<Result<Request, RpcError>>,
) -> Vec<Result<Reply, RpcError>> {
    let begin = |request: Result<Request, RpcError>| async move {
        tokio::time::timeout(CALL_TIMEOUT, service.answer(request?, origin)).await.unwrap_or_else(late)
    };
    let mut begun: Vec<_> = requests.into_iter().map(|request| (Box::pin(begin(request)), None)).collect();
    poll_fn(|context| {
        for (asked, answer) in begun.iter_mut().filter(|(_, answer)| answer.is_none()) {
            if let Poll::Ready(answered) = asked.as_mut().poll(context) {
                *answer = Some(answered);
            }
        }
        let done = begun.iter().all(|(_, answer)| answer.is_some());
        if done { Poll::Ready(()) } else { Poll::Pending }
    })
    .await;
    begun.into_iter().map(|(_, answer)| answer.unwrap_or_else(|| Err(defect("no answer")))).collect()
}

fn late(_: tokio::time::error::Elapsed) -> Result<Reply, RpcError> {
    let what = format!("the run did not answer within {} s", CALL_TIMEOUT.as_secs());
    Err(RpcError::new(Code::NoAnswer, what).hint("the request may still take effect"))
}

/// Converts a request for the service, with the checks of the socket.
fn typed<M: Method>(request: &M) -> Result<Request, RpcError> {
    request.check().map_err(|what| RpcError::new(Code::InvalidParams, format!("params of {:?}: {what}", M::NAME)))?;
    request.to_request().ok_or_else(|| RpcError::unknown(Code::UnknownMethod, "method", M::NAME, METHODS))
}

fn reply<M: Method>(reply: Reply) -> Result<M::Reply, RpcError> {
    M::from_reply(reply).ok_or_else(|| defect("the answer is that to another request"))
}

/// Error for a state that cannot occur.
pub fn defect(what: &str) -> RpcError {
    RpcError::new(Code::Internal, format!("a defect of the program: {what}"))
}
