//! What the metrics of a run, and of an attached planner, are made of.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

use crate::blueprint::{Blueprint, MetricsConfig};
use crate::metrics::{Bound, Figures, LogFigures, Metrics};
use crate::runtime::plan::PlannerPort;
use crate::runtime::{Service, StartError};
use dimos_core::sync::lock;
use dimos_core::telemetry::Origin;
use dimos_log::disk_space;
use dimos_rpc::RpcError;
use dimos_rpc::api::{Reply, Request};

/// Takes the address of the metrics, if the blueprint has them: before an arm is connected.
pub fn bind(blueprint: &Blueprint) -> Result<Option<Bound>, StartError> {
    let bind = |config: &MetricsConfig| {
        Bound::at(config.listen).map_err(|error| {
            let hint = "another run may have it: --set metrics.listen=127.0.0.1:PORT";
            StartError::other(format!("the metrics cannot be served at {}: {error}", config.listen), hint)
        })
    };
    blueprint.metrics.as_ref().map(bind).transpose()
}

/// Serves the metrics of a run.
pub(in crate::runtime) fn serve(bound: Bound, service: &Arc<Service>) -> Result<Metrics, StartError> {
    let run = Arc::downgrade(service);
    let served = bound.serve(move |form| Some(run.upgrade()?.figures().text(form)));
    let served =
        served.map_err(|error| StartError::other(format!("the metrics cannot be served: {error}"), "see ulimit -u"))?;
    let _ = service.journal.metrics.set(served.url().to_owned());
    Ok(served)
}

impl Service {
    /// Answers a request, and counts a refusal.
    pub(in crate::runtime) async fn answer_counted(&self, call: Request, origin: Origin) -> Result<Reply, RpcError> {
        let method = call.method();
        self.answer(call, origin).await.inspect_err(|error| self.count_refusal(method, error))
    }

    /// Counts a request that was refused.
    pub(in crate::runtime) fn count_refusal(&self, method: &'static str, error: &RpcError) {
        lock(&self.journal.counts).refused(method, &error.code);
    }

    fn figures(&self) -> Figures {
        let pulse = self.tick.pulse();
        let log =
            self.facts.log.as_ref().zip(self.journal.recorder.get()).map(|(path, stats)| LogFigures {
                written: stats.bytes.load(Relaxed),
                free: disk_space::free(path).ok(),
            });
        Figures {
            status: self.status(),
            started: self.wall_seconds() - self.lifecycle.uptime().as_secs_f64(),
            lateness: pulse.lateness.cumulative(),
            compute: pulse.compute.cumulative(),
            log,
            planner: self.plans.port().map(PlannerPort::figures),
            counts: lock(&self.journal.counts).clone(),
        }
    }
}
