/* Reads the records of weights that companion sends ([records] in its settings): datagrams, and a
 * ring in shared memory. C99 and C++11, one header, no library. Little-endian machines only.
 *
 * A record is a header, an entry for each beam, and the weights (complex64: float real, float
 * imaginary), beam after beam. UAV n receives sum_m a(u_n)_m w[n][m]: no conjugate. Unknown is NaN.
 */
#ifndef UAV_BEAMS_H
#define UAV_BEAMS_H

#include <fcntl.h>
#include <stdint.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#ifdef __cplusplus
extern "C" {
#endif

#define UAVB_VERSION 1u
#define UAVB_COMPLEX64 1u
#define UAVB_LARGEST 65520u /* bytes of the largest record */

enum uavb_error {
    UAVB_OK = 0,
    UAVB_SHORT = -1,    /* fewer bytes than the record has */
    UAVB_FOREIGN = -2,  /* not a record */
    UAVB_NEWER = -3,    /* unknown version, or unknown type of weights */
    UAVB_DAMAGED = -4,  /* wrong checksum or offsets */
    UAVB_NOTHING = -5,  /* the ring has no newer record */
    UAVB_ENDED = -6     /* no newer record, and its writer has ended: open it again */
};

struct uavb_header {
    char magic[8];
    uint32_t version, bytes, crc32, header_bytes;
    uint64_t sequence; /* of the update, from 0 */
    int64_t made_at_ns, valid_at_ns; /* ns since the Unix epoch */
    uint32_t elements, beams, first_beam, all_beams;
    uint32_t dtype, beam_bytes, beams_at, weights_at;
    uint32_t normalisation, flags;
    uint64_t revision; /* 0: part of a whole update; else a beam renewed since, from 1 */
};

struct uavb_beam {
    char uav[72]; /* ends with at least one 0 */
    uint32_t group, flags;
    double azimuth_rad, elevation_rad, azimuth_rate_radps, elevation_rate_radps;
    double range_m, pointing_bound_rad, gain_db, guaranteed_gain_db;
};

/* A valid record: pointers into the caller's bytes, which must be aligned to 8. */
struct uavb_record {
    const struct uavb_header *header;
    const unsigned char *bytes;
};

static inline uint32_t uavb_crc32(const unsigned char *bytes, size_t size)
{
    uint32_t table[16], crc = 0xFFFFFFFFu, i, k; /* four bits at a time */
    for (i = 0; i < 16; i++) {
        table[i] = i;
        for (k = 0; k < 4; k++)
            table[i] = (table[i] >> 1) ^ (0xEDB88320u & (0u - (table[i] & 1u)));
    }
    while (size--) {
        crc ^= *bytes++;
        crc = (crc >> 4) ^ table[crc & 15u];
        crc = (crc >> 4) ^ table[crc & 15u];
    }
    return ~crc;
}

/* Check `size` bytes at `bytes`, and make `record` point into them. */
static inline int uavb_parse(const void *bytes, size_t size, struct uavb_record *record)
{
    const struct uavb_header *h = (const struct uavb_header *)bytes;
    uint64_t beams_end, weights_end;
    uint32_t n;
    if (size < sizeof *h)
        return UAVB_SHORT;
    if (memcmp(h->magic, "UAVBEAMS", 8) != 0)
        return UAVB_FOREIGN;
    if (h->version != UAVB_VERSION || h->dtype != UAVB_COMPLEX64)
        return UAVB_NEWER;
    if (h->bytes > size)
        return UAVB_SHORT;
    beams_end = h->beams_at + (uint64_t)h->beams * h->beam_bytes;
    weights_end = h->weights_at + (uint64_t)h->beams * h->elements * 8u;
    if (h->bytes < sizeof *h || h->beam_bytes < sizeof(struct uavb_beam) || h->beam_bytes % 8 ||
        h->beams_at < sizeof *h || h->beams_at % 8 || h->weights_at % 8 ||
        beams_end > h->weights_at || weights_end > h->bytes ||
        uavb_crc32((const unsigned char *)bytes + 20, h->bytes - 20) != h->crc32)
        return UAVB_DAMAGED;
    for (n = 0; n < h->beams; n++) {
        const void *at = (const char *)bytes + h->beams_at + (size_t)n * h->beam_bytes;
        const struct uavb_beam *beam = (const struct uavb_beam *)at;
        if (beam->uav[sizeof beam->uav - 1] != 0)
            return UAVB_DAMAGED;
    }
    record->header = h;
    record->bytes = (const unsigned char *)bytes;
    return UAVB_OK;
}

/* Entry of beam n of a record, n below its header's `beams`. */
static inline const struct uavb_beam *uavb_beam_of(const struct uavb_record *record, uint32_t n)
{
    const struct uavb_header *h = record->header;
    return (const struct uavb_beam *)(record->bytes + h->beams_at + (size_t)n * h->beam_bytes);
}

/* Weights of beam n: 2 * elements floats, real and imaginary parts alternating. */
static inline const float *uavb_weights_of(const struct uavb_record *record, uint32_t n)
{
    const struct uavb_header *h = record->header;
    return (const float *)(record->bytes + h->weights_at + (size_t)n * h->elements * 8u);
}

/* --- the ring in shared memory ------------------------------------------------------------- */

struct uavb_ring {
    const unsigned char *map;
    size_t size;
    uint32_t slots, slot_bytes;
    uint64_t next; /* number of the next record to read */
    uint64_t lost; /* records overwritten before they were read */
};

static inline uint64_t uavb_load(const unsigned char *at)
{
    return __atomic_load_n((const uint64_t *)(const void *)at, __ATOMIC_ACQUIRE);
}

/* Open a ring, starting at its newest record. */
static inline int uavb_ring_open(struct uavb_ring *ring, const char *path)
{
    struct stat found;
    uint32_t head[4];
    uint64_t written;
    void *map = MAP_FAILED;
    int fd = open(path, O_RDONLY);
    if (fd < 0)
        return UAVB_FOREIGN;
    if (fstat(fd, &found) == 0 && found.st_size >= 64)
        map = mmap(NULL, (size_t)found.st_size, PROT_READ, MAP_SHARED, fd, 0);
    close(fd);
    if (map == MAP_FAILED)
        return UAVB_FOREIGN;
    memset(ring, 0, sizeof *ring);
    ring->map = (const unsigned char *)map;
    ring->size = (size_t)found.st_size;
    memcpy(head, ring->map + 8, sizeof head);
    ring->slots = head[1];
    ring->slot_bytes = head[2];
    if (memcmp(ring->map, "UAVBRING", 8) != 0 || head[0] != 1 || ring->slots == 0 ||
        ring->slot_bytes < 16 || ring->slot_bytes % 64 ||
        64 + (uint64_t)ring->slots * ring->slot_bytes > ring->size) {
        munmap(map, ring->size);
        return UAVB_FOREIGN;
    }
    written = uavb_load(ring->map + 24);
    ring->next = written ? written - 1 : 0;
    return UAVB_OK;
}

/* Copy the next record to `to` (UAVB_LARGEST bytes, aligned to 8) and check it. */
static inline int uavb_ring_next(struct uavb_ring *ring, void *to, struct uavb_record *record)
{
    unsigned tries;
    for (tries = 0; tries < 1000; tries++) {
        const unsigned char *slot =
            ring->map + 64 + (size_t)(ring->next % ring->slots) * ring->slot_bytes;
        uint64_t written = uavb_load(ring->map + 24), wanted = 2 * ring->next + 2;
        uint32_t size, live;
        if (ring->next >= written) {
            memcpy(&live, ring->map + 20, sizeof live);
            return live ? UAVB_NOTHING : UAVB_ENDED;
        }
        if (uavb_load(slot) == wanted) {
            memcpy(&size, slot + 8, sizeof size);
            if (size <= ring->slot_bytes - 16 && size <= UAVB_LARGEST) {
                memcpy(to, slot + 16, size);
                __atomic_thread_fence(__ATOMIC_ACQUIRE);
                if (uavb_load(slot) == wanted && uavb_parse(to, size, record) == UAVB_OK) {
                    ring->next++;
                    return UAVB_OK;
                }
            }
        }
        if (uavb_load(slot) > wanted) { /* overwritten: skip to half a ring behind the writer */
            written = uavb_load(ring->map + 24);
            wanted = written - ring->slots / 2;
            ring->lost += wanted - ring->next;
            ring->next = wanted;
        }
    }
    ring->next++; /* it does not change any more: no writer */
    ring->lost++;
    return UAVB_DAMAGED;
}

/* Skip to the newest record. */
static inline void uavb_ring_newest(struct uavb_ring *ring)
{
    uint64_t written = uavb_load(ring->map + 24);
    if (written > ring->next)
        ring->next = written - 1;
}

static inline void uavb_ring_close(struct uavb_ring *ring)
{
    munmap((void *)(uintptr_t)ring->map, ring->size);
}

#ifdef __cplusplus
}
#endif
#endif
