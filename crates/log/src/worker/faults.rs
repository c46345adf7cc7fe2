//! The logs of faults, of a run that is not recorded.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Seek, Write};
use std::path::Path;

use super::{Worker, write_error};
use crate::fault_ring::FaultRing;
use crate::recorder::{Note, Notice, RecordError};
use crate::rewrite::PART_OF;
use crate::storage::FaultLog;
use crate::{disk_space, files};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::telemetry::Sample;

impl<W, F, O> Worker<W, F, O>
where
    W: Write + Seek,
    F: FnMut(Notice<'_>),
    O: FnMut(&Path) -> Result<(W, Option<File>), RecordError>,
{
    /// Keeps what came while there is no log.
    pub(super) fn keep(&mut self, notes: Vec<Note>, samples: Vec<Sample>) {
        for note in notes {
            self.know(&note);
            let known =
                matches!(note, Note::Robots { .. } | Note::Markers { .. } | Note::ArmText { .. } | Note::Asked { .. });
            if let (Some((_, ring)), false) = (&mut self.faults, known) {
                ring.note(note);
            }
        }
        if let Some((_, ring)) = &mut self.faults {
            samples.into_iter().for_each(|sample| ring.sample(sample));
        }
    }

    /// Makes a log of what was kept.
    pub(super) fn log_fault(&mut self) -> Result<(), RecordError> {
        let Some((faults, mut ring)) = self.faults.take() else { return Ok(()) };
        let done = self.write_kept(&faults, &mut ring);
        ring.clear();
        self.faults = Some((faults, ring));
        done
    }

    fn write_kept(&mut self, faults: &FaultLog, ring: &mut FaultRing) -> Result<(), RecordError> {
        (self.until, self.faulted) = (Some(Mono(u64::MAX)), false);
        let stamp = ring.begin().unwrap_or_default();
        let wall = self.config.wall.wall(MonotonicClock.now());
        let path = files::new_log_path(&faults.folder, &format!("{}-fault", self.config.run), wall);
        disk_space::check(&path, self.config.storage.min_free)?;
        let part = (PART_OF.to_owned(), "a run whose beginning was not kept".to_owned());
        self.begin(path, stamp, (!ring.whole).then_some(part).into_iter().collect::<BTreeMap<_, _>>())?;
        while let Some((notes, sample)) = ring.next() {
            self.put(notes, &[sample])?;
        }
        self.put(ring.rest(), &[])
    }

    /// Ends the log of a fault.
    pub(super) fn end_fault(&mut self) -> Result<(), RecordError> {
        let (Some(log), Some((faults, _))) = (self.log.take(), &self.faults) else { return Ok(()) };
        (self.until, self.disk) = (None, None);
        log.finish().map_err(|e| write_error(&self.path, &e))?;
        if faults.keep > 0 {
            // What cannot be removed remains.
            let _ = files::retain(&faults.folder, faults.keep);
        }
        (self.on_notice)(Notice::Fault(Ok(&self.path)));
        Ok(())
    }
}
