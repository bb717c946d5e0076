// Counts the events in a ring of amiwarp (docs/reference/stream-format.md, "Shared memory").
//     rustc -O --edition 2021 reader.rs && ./reader NAME
use std::sync::atomic::{fence, AtomicU64, Ordering::{Acquire, SeqCst}};
use std::{env, ffi::{c_char, CString}, fs::File, os::fd::{AsRawFd, FromRawFd}, process::exit, ptr, thread, time::Duration};

extern "C" {
    fn shm_open(name: *const c_char, flags: i32, mode: u32) -> i32;
    fn mmap(place: *mut u8, size: usize, protection: i32, flags: i32, file: i32, offset: i64) -> *mut u8;
}

fn crc32(data: &[u8], table: &[u32; 256]) -> u32 {
    !data.iter().fold(!0, |crc, &byte| crc >> 8 ^ table[(crc as u8 ^ byte) as usize])
}

fn u32_at(data: &[u8], place: usize) -> u32 {
    u32::from_le_bytes(data[place..place + 4].try_into().unwrap())
}

fn main() {
    let mut table = [0u32; 256];
    for k in 0..256 {
        table[k] = (0..8).fold(k as u32, |c, _| c >> 1 ^ if c & 1 == 1 { 0xEDB88320 } else { 0 });
    }
    let name = CString::new(format!("/{}", env::args().nth(1).expect("give the NAME of shm:NAME"))).unwrap();
    let descriptor = unsafe { shm_open(name.as_ptr(), 0, 0) };
    assert!(descriptor >= 0, "there is no such shared memory");
    let file = unsafe { File::from_raw_fd(descriptor) };
    let size = file.metadata().unwrap().len() as usize;
    let ring = unsafe { mmap(ptr::null_mut(), size, 1, 1, file.as_raw_fd(), 0) };
    assert!(ring as isize != -1, "the memory cannot be mapped");
    let copy = |place: usize, size: usize| unsafe { std::slice::from_raw_parts(ring.add(place), size) }.to_vec();
    let word = |place: usize| unsafe { &*(ring.add(place) as *const AtomicU64) }.load(SeqCst);
    let head = copy(0, 24); // magic, version, number and size of slots, size of the hello, place of slot 0
    assert!(&head[..8] == b"AMIR\x01\0\0\0", "no ring of version 1");
    let (slots, slot_bytes, place) = (u32_at(&head, 8) as u64, u32_at(&head, 12) as usize, u32_at(&head, 20) as usize);
    let (mut number, mut beat, mut idle, mut events, mut lost) = (word(32), word(40), 0, 0, 0);
    println!("reading");
    while idle < 6000 {
        // 3 s without a beat: the writer died
        let ahead = word(32) - number;
        if ahead == 0 {
            idle = if word(40) == beat { idle + 1 } else { 0 };
            beat = word(40);
            thread::sleep(Duration::from_micros(500));
            continue;
        }
        if ahead >= slots {
            // overtaken: go on in the middle of the ring
            lost += ahead - slots / 2;
            number += ahead - slots / 2;
        }
        let start = place + (number % slots) as usize * slot_bytes;
        if word(start) != number + 1 {
            continue;
        }
        let slot = copy(start + 8, 8); // length and check
        let length = u32_at(&slot, 0) as usize;
        if length < 20 || length > slot_bytes - 16 {
            continue;
        }
        let packet = copy(start + 16, length);
        fence(Acquire);
        let checksum = u32_at(&packet, 16);
        let fits = checksum == u32_at(&slot, 4) ^ (number + 1) as u32 && checksum == crc32(&packet[20..], &table);
        if word(start) != number + 1 || !fits {
            continue;
        }
        number += 1;
        match packet[5] {
            2 | 3 => events += u32_at(&packet, 8) as u64, // events, or compensated events
            6 => return println!("{events} events, {lost} packets lost"),
            _ => {}
        }
    }
    eprintln!("the writer died");
    exit(1);
}
