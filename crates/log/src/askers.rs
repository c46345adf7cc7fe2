//! Who asked for what happened: requests and their askers, and which events of a tick are their effects.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::notes::Note;
use dimos_core::telemetry::describe::follows_request;
use dimos_core::telemetry::{Event, Sample, Who};

/// Number of requests whose askers are remembered.
const REMEMBERED: usize = 4096;

/// The latest requests and their askers.
#[derive(Debug, Default)]
pub(super) struct Askers {
    /// By the request's id.
    asked: BTreeMap<u64, Arc<Who>>,
    /// Tick of the latest answer to a request, and who made that.
    answer: (u64, Option<Arc<Who>>),
}

impl Askers {
    /// Takes what a note says of it.
    pub fn know(&mut self, note: &Note) {
        let Note::Asked { id, who } = note else { return };
        while self.asked.len() >= REMEMBERED {
            self.asked.pop_first();
        }
        self.asked.insert(*id, who.clone());
    }

    /// Returns who asked for an event of a tick, if it is the effect of a client's request. `later`: what that tick
    /// reported after it. A request's answer comes after its effects on arms, and before those on tasks.
    pub fn of(&mut self, tick: u64, event: &Event, later: &[Sample]) -> Option<String> {
        let answered = |event: &Event| match event {
            Event::Request(id, _) => Some(self.asked.get(id).cloned()),
            _ => None,
        };
        let same = later.iter().take_while(|sample| !matches!(sample, Sample::Tick(_)));
        let mut same = same.filter_map(|sample| if let Sample::Event(_, event) = sample { Some(event) } else { None });
        if let Some(who) = answered(event).or_else(|| same.find_map(answered)) {
            self.answer = (tick, who);
        }
        let (at, who) = &self.answer;
        who.as_ref().filter(|_| *at == tick && follows_request(event)).map(|who| who.to_string())
    }
}
