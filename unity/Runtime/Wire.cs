using System;
using System.Text;

namespace CapSense
{
    /// <summary>A depth image, with what is seen in it.</summary>
    public sealed class DepthFrame
    {
        /// <summary>Number of rows and columns.</summary>
        public readonly int Rows, Columns;

        /// <summary>Depths [m], row after row; 0 and NaN are air.</summary>
        public readonly float[] Depth;

        /// <summary>Permittivity codes, one a pixel; null where the sensor's material is seen.</summary>
        public readonly byte[] Codes;

        /// <summary>Time of the image [s].</summary>
        public double Time;

        /// <exception cref="ArgumentException">An array has another size than the image.</exception>
        public DepthFrame(int rows, int columns, float[] depth, byte[] codes = null, double time = 0)
        {
            if (rows < 1 || columns < 1 || depth == null || depth.Length != rows * columns)
                throw new ArgumentException("depth must hold rows x columns numbers");
            if (codes != null && codes.Length != depth.Length)
                throw new ArgumentException("codes must be as many as depths");
            Rows = rows;
            Columns = columns;
            Depth = depth;
            Codes = codes;
            Time = time;
        }
    }

    /// <summary>What a chip reports of one channel.</summary>
    public struct Conversion
    {
        /// <summary>When the result could be read [s].</summary>
        public double Time;

        /// <summary>What the converter put out.</summary>
        public long Code;

        /// <summary>What its user makes of the code [F].</summary>
        public double Capacitance;

        /// <summary>Tracked baseline [codes], where there is a detector.</summary>
        public double Baseline;

        /// <summary>Number of the channel.</summary>
        public int Channel;

        /// <summary>1 below, 2 above the chip's range.</summary>
        public byte Flags;

        /// <summary>0 released, 1 touched, 255 no detector.</summary>
        public byte State;
    }

    /// <summary>The capacitances of one instant.</summary>
    public sealed class Reading
    {
        /// <summary>Number and time [s] of the frame that it answers.</summary>
        public long Sequence;
        public double Time;

        /// <summary>Maxwell capacitance matrix [F].</summary>
        public double[,] Capacitance;

        /// <summary>Its change from the empty scene [F].</summary>
        public double[,] Delta;

        /// <summary>What self-mode channels measure [F].</summary>
        public double[] SelfCapacitance;

        /// <summary>Iterations of the solver.</summary>
        public long Iterations;

        /// <summary>Frames that newer ones replaced before they were solved.</summary>
        public long Dropped;

        /// <summary>Estimated error of a capacitance [F].</summary>
        public double ErrorEstimate;

        /// <summary>Time that the step took on the server [s].</summary>
        public double WallTime;

        /// <summary>What the readout has reported since the last reading.</summary>
        public Conversion[] Conversions;
    }

    /// <summary>Binary messages of the protocol, little-endian.</summary>
    public static class Wire
    {
        /// <summary>Version of the protocol.</summary>
        public const int Protocol = 1;

        private const int HeaderSize = 40, SummarySize = 24, ConversionSize = 40;
        private const byte DepthKind = 1, ReadingKind = 2;
        private static readonly byte[] Magic = Encoding.ASCII.GetBytes("CSNS");

        /// <summary>Bytes of the message of a frame.</summary>
        public static int SizeOf(DepthFrame frame)
        {
            return HeaderSize + (frame.Codes == null ? 4 : 5) * frame.Depth.Length;
        }

        /// <summary>Write the message of a frame to the start of a buffer.</summary>
        public static void Pack(byte[] buffer, long sensor, long sequence, DepthFrame frame)
        {
            if (!BitConverter.IsLittleEndian) throw new PlatformNotSupportedException("big-endian");
            Buffer.BlockCopy(Magic, 0, buffer, 0, 4);
            buffer[4] = Protocol;
            buffer[5] = DepthKind;
            buffer[6] = (byte)(frame.Codes == null ? 0 : 1);
            buffer[7] = 0;
            Put(buffer, 8, BitConverter.GetBytes((uint)sensor));
            Put(buffer, 12, BitConverter.GetBytes((uint)frame.Rows));
            Put(buffer, 16, BitConverter.GetBytes((uint)frame.Columns));
            Put(buffer, 20, BitConverter.GetBytes((uint)(SizeOf(frame) - HeaderSize)));
            Put(buffer, 24, BitConverter.GetBytes((ulong)sequence));
            Put(buffer, 32, BitConverter.GetBytes(frame.Time));
            int bytes = 4 * frame.Depth.Length;
            Buffer.BlockCopy(frame.Depth, 0, buffer, HeaderSize, bytes);
            if (frame.Codes != null)
                Buffer.BlockCopy(frame.Codes, 0, buffer, HeaderSize + bytes, frame.Codes.Length);
        }

        /// <summary>The reading in a message, and the number of its sensor.</summary>
        /// <exception cref="CapSenseException">The message is no reading of this version.</exception>
        public static Reading Unpack(byte[] data, int count, out long sensor)
        {
            if (count < HeaderSize) throw Malformed("is shorter than its header");
            for (int k = 0; k < 4; k++)
                if (data[k] != Magic[k]) throw Malformed("does not start with CSNS");
            if (data[4] != Protocol) throw new CapSenseException("version", "a message has version " + data[4]);
            if (data[5] != ReadingKind) throw Malformed("has kind " + data[5]);
            sensor = BitConverter.ToUInt32(data, 8);
            long m = BitConverter.ToUInt32(data, 12), conversions = BitConverter.ToUInt32(data, 16);
            long numbers = m * (2 * m + 1);
            if (m > 4096 || count - HeaderSize != SummarySize + 8 * numbers + ConversionSize * conversions
                || BitConverter.ToUInt32(data, 20) != count - HeaderSize)
                throw Malformed("has a wrong size");
            int at = HeaderSize + SummarySize, block = (int)(8 * m * m);
            var reading = new Reading
            {
                Sequence = (long)BitConverter.ToUInt64(data, 24),
                Time = BitConverter.ToDouble(data, 32),
                Iterations = BitConverter.ToUInt32(data, HeaderSize),
                Dropped = BitConverter.ToUInt32(data, HeaderSize + 4),
                ErrorEstimate = BitConverter.ToDouble(data, HeaderSize + 8),
                WallTime = BitConverter.ToDouble(data, HeaderSize + 16),
                Capacitance = new double[m, m],
                Delta = new double[m, m],
                SelfCapacitance = new double[m],
                Conversions = new Conversion[conversions],
            };
            Buffer.BlockCopy(data, at, reading.Capacitance, 0, block);
            Buffer.BlockCopy(data, at + block, reading.Delta, 0, block);
            Buffer.BlockCopy(data, at + 2 * block, reading.SelfCapacitance, 0, (int)(8 * m));
            at += (int)(8 * numbers);
            for (int k = 0; k < conversions; k++, at += ConversionSize)
                reading.Conversions[k] = new Conversion
                {
                    Time = BitConverter.ToDouble(data, at),
                    Code = BitConverter.ToInt64(data, at + 8),
                    Capacitance = BitConverter.ToDouble(data, at + 16),
                    Baseline = BitConverter.ToDouble(data, at + 24),
                    Channel = BitConverter.ToUInt16(data, at + 32),
                    Flags = data[at + 34],
                    State = data[at + 35],
                };
            return reading;
        }

        private static void Put(byte[] buffer, int at, byte[] bytes)
        {
            Buffer.BlockCopy(bytes, 0, buffer, at, bytes.Length);
        }

        private static CapSenseException Malformed(string what)
        {
            return new CapSenseException("malformed", "a message from the server " + what);
        }
    }

    /// <summary>The server refused something, or a message broke the protocol.</summary>
    public sealed class CapSenseException : Exception
    {
        /// <summary>What is wrong, one of the protocol's codes, or "closed".</summary>
        public readonly string Code;

        public CapSenseException(string code, string message) : base(message)
        {
            Code = code;
        }
    }
}
