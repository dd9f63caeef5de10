/* Writes the records of observations that companion receives over UDP ([observations] udp in its
 * settings): the direction of a UAV as the array sees it, or the powers received through beams. Send
 * each record as one datagram. C99 and C++11, one header, no library. Little-endian machines only.
 *
 * Times are UTC, in ns since the Unix epoch. Angles are in radians in the array's frame: azimuth is
 * positive to the right of boresight, elevation above it. Powers are in dB on any common scale: only
 * their differences are used. Indices of beams count the columns of the weights, from 0.
 *
 *     struct uavo_record record;
 *     uavo_begin(&record, "3:1", measured_at_ns, time_bound_ns);
 *     size_t size = uavo_direction(&record, azimuth_rad, elevation_rad, bound_rad);
 *     send(fd, &record, size, 0);
 */
#ifndef UAV_OBSERVATIONS_H
#define UAV_OBSERVATIONS_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

#define UAVO_VERSION 1u
#define UAVO_DIRECTION 1u
#define UAVO_POWERS 2u
#define UAVO_CODEBOOK (-1) /* number of the update if beams of the codebook were used */
#define UAVO_READINGS_MAX 256u /* most powers; up to 77 fit into a datagram of 1400 bytes */
#define UAVO_NAME_MAX 71u      /* longest name of a UAV */

struct uavo_reading {
    uint32_t beam, reserved;
    double power_db;
};

struct uavo_header {
    char magic[8];
    uint32_t version, bytes, crc32, kind;
    char uav[72]; /* such as "3:1" or "icao:4CA7B3"; ends with at least one 0 */
    int64_t measured_at_ns; /* ns since the Unix epoch */
    uint64_t time_bound_ns; /* largest error of measured_at_ns */
    double azimuth_rad, elevation_rad, bound_rad; /* NaN in a record of powers */
    double power_bound_db; /* NaN in a record of a direction */
    int64_t update; /* number of the update whose weights were used, or UAVO_CODEBOOK */
    uint32_t readings, flags; /* flags are 0 */
};

struct uavo_record {
    struct uavo_header header;
    struct uavo_reading readings[UAVO_READINGS_MAX];
};

static inline uint32_t uavo_crc32(const unsigned char *bytes, size_t size)
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

/* Begin a record. Return 0, or -1 if the name is longer than UAVO_NAME_MAX. */
static inline int uavo_begin(struct uavo_record *record, const char *uav, int64_t measured_at_ns,
                             uint64_t time_bound_ns)
{
    struct uavo_header *h = &record->header;
    if (strlen(uav) > UAVO_NAME_MAX)
        return -1;
    memset(h, 0, sizeof *h);
    memcpy(h->magic, "UAVOBSRV", 8);
    memcpy(h->uav, uav, strlen(uav));
    h->version = UAVO_VERSION;
    h->measured_at_ns = measured_at_ns;
    h->time_bound_ns = time_bound_ns;
    h->azimuth_rad = h->elevation_rad = h->bound_rad = h->power_bound_db = (double)NAN;
    h->update = UAVO_CODEBOOK;
    return 0;
}

static inline size_t uavo_end(struct uavo_record *record)
{
    struct uavo_header *h = &record->header;
    h->bytes = (uint32_t)(sizeof *h + h->readings * sizeof(struct uavo_reading));
    h->crc32 = uavo_crc32((const unsigned char *)record + 20, h->bytes - 20);
    return h->bytes;
}

/* Complete a record with a direction. Return its size in bytes. */
static inline size_t uavo_direction(struct uavo_record *record, double azimuth_rad,
                                    double elevation_rad, double bound_rad)
{
    struct uavo_header *h = &record->header;
    h->kind = UAVO_DIRECTION;
    h->azimuth_rad = azimuth_rad;
    h->elevation_rad = elevation_rad;
    h->bound_rad = bound_rad;
    return uavo_end(record);
}

/* Add the power received through one beam. Return 0, or -1 if the record is full. */
static inline int uavo_add_power(struct uavo_record *record, uint32_t beam, double power_db)
{
    struct uavo_header *h = &record->header;
    struct uavo_reading *reading = &record->readings[h->readings];
    if (h->readings >= UAVO_READINGS_MAX)
        return -1;
    h->readings++;
    reading->beam = beam;
    reading->reserved = 0;
    reading->power_db = power_db;
    return 0;
}

/* Complete a record with the powers that were added: at least two. Return its size in bytes. */
static inline size_t uavo_powers(struct uavo_record *record, double bound_db, int64_t update)
{
    struct uavo_header *h = &record->header;
    h->kind = UAVO_POWERS;
    h->power_bound_db = bound_db;
    h->update = update;
    return uavo_end(record);
}

#ifdef __cplusplus
}
#endif
#endif
